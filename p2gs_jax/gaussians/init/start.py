"""The first Gaussians: of the scene's points, of dense seeds, and of a far shell."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.gaussians.init.brightness import Tones
from p2gs_jax.gaussians.init.dense import MOST_VIEWS, DenseSeeds, dense_seeds
from p2gs_jax.gaussians.init.seeds import gaussians_from_points, merge, neighbour_scales
from p2gs_jax.gaussians.init.shell import Shell
from p2gs_jax.photometry.formation import inverse_formation, places
from p2gs_jax.photometry.sources.sampling import sample
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Gaussians, Photometry, Scene, View

# Of a time budget at most this share goes into dense seeds, if two idle cores need so long a view.
DENSE_TIME, DENSE_SECONDS, FEWEST_DENSE_VIEWS = 0.25, 0.6, 8
# Shell colours come from small images: a direction covers many pixels.
SHELL_SHRINK = 4
SHELL_OPACITY = 0.5


def black_gaussians(
    points: np.ndarray, shell: Shell | None, views: Sequence[View], cfg: FitConfig
) -> Gaussians:
    """Return Gaussians of points and shell without colours: enough to compile for."""
    views = list(views)
    black = gaussians_from_points(points, np.zeros_like(points), views, cfg)
    if shell is None:
        return black
    far = gaussians_from_points(
        shell.points, np.zeros_like(shell.points), views, cfg, scales=shell.scales
    )
    return merge(black, far)


def match_photographs(
    scene: Scene,
    store: ImageStore,
    match: Tones,
    points: np.ndarray,
    photometry: Photometry,
    cfg: FitConfig,
    *,
    limit: int,
    on_view: Callable[[int, int], None],
) -> DenseSeeds:
    """Find dense seeds, with radiances in the gauge of the exposures that the fit starts from.

    Args:
        scene: views and points.
        store: photographs.
        match: brings photographs to one brightness, for matching.
        points: seeds that are there already.
        photometry: of the start.
        cfg: everything.
        limit: number of seeds at most.
        on_view: receives progress.
    """
    most_views, budget = MOST_VIEWS, cfg.train.budget_s
    if budget is not None:
        affordable = int(DENSE_TIME * budget / DENSE_SECONDS)
        most_views = min(most_views, max(affordable, FEWEST_DENSE_VIEWS))
    tones = Tones.of(photometry, cfg.photometry)
    return dense_seeds(
        scene,
        store,
        match,
        tones,
        cfg,
        existing=points,
        limit=limit,
        most_views=most_views,
        on_view=on_view,
    )


def gaussians_of(
    points: np.ndarray,
    radiance: np.ndarray,
    dense: DenseSeeds | None,
    views: Sequence[View],
    cfg: FitConfig,
) -> Gaussians:
    """Return Gaussians of the scene's points and of dense seeds, the former first.

    A point that has dense seeds around it is as small as they are near.

    Args:
        points: scene units.
        radiance: of the points, in the gauge of the exposures.
        dense: seeds beside the points, or None.
        views: training views.
        cfg: everything.
    """
    views = list(views)
    if dense is None:
        return gaussians_from_points(points, radiance, views, cfg)
    everything = np.concatenate([points, dense.points])
    count = len(points)
    scales = np.repeat(neighbour_scales(everything, views)[:, None], 3, 1)
    scales[count:] = dense.scales
    opacity = np.full(len(everything), cfg.init.opacity)
    opacity[count:] = cfg.init.dense_opacity
    quats = np.tile(np.eye(1, 4), (len(everything), 1))
    quats[count:] = dense.quats
    return gaussians_from_points(
        everything,
        np.concatenate([radiance, dense.radiance]),
        views,
        cfg,
        scales=scales,
        opacity=opacity,
        quats=quats,
    )


def shell_gaussians(
    shell: Shell,
    scene: Scene,
    store: ImageStore,
    photometry: Photometry,
    views: Sequence[View],
    cfg: FitConfig,
) -> Gaussians:
    """Return the Gaussians of a shell, coloured by what the photographs show in its directions.

    Args:
        shell: directions, positions, sizes.
        scene: views.
        store: photographs.
        photometry: of the start.
        views: training views.
        cfg: everything.
    """
    taken: Photometry = jax.tree.map(np.asarray, photometry)
    total = np.zeros((len(shell.points), 3))
    weight = np.zeros(len(shell.points))
    for row, index in enumerate(scene.train_indices):
        seen = np.flatnonzero(shell.seen[:, row])
        if not len(seen):
            continue
        ldr, mask = store.get(index, SHELL_SHRINK)
        view = scene.views[index]
        scale = [mask.shape[1] / view.width, mask.shape[0] / view.height]
        xy = shell.xy[seen, row] * scale
        samples = sample(ldr, mask, xy)
        valid = samples.valid
        place = places(xy[valid], *mask.shape[::-1])
        colors = np.asarray(samples.colors[valid], np.float32)
        total[seen[valid]] += inverse_formation(colors, taken.capture(row), cfg.photometry, place)
        weight[seen[valid]] += 1
    seen = weight > 0
    radiance = total[seen] / weight[seen, None]
    return gaussians_from_points(
        shell.points[seen],
        radiance.astype(np.float32),
        list(views),
        cfg,
        scales=shell.scales[seen],
        opacity=SHELL_OPACITY,
    )
