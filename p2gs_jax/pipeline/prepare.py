"""Everything before the first optimisation step: scene, exposures, radiances, Gaussians."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.init.brightness import Tones, rough_tones
from p2gs_jax.gaussians.init.dense import FEWEST_VIEWS, MOST_VIEWS, DenseSeeds, dense_seeds
from p2gs_jax.gaussians.init.seeds import (
    gaussians_from_points,
    merge,
    neighbour_scales,
    scene_extent,
    subsample,
)
from p2gs_jax.gaussians.init.shell import Shell, find_shell
from p2gs_jax.gaussians.population import Coverage, default_max_gaussians
from p2gs_jax.losses.relative_exposure import ColorPairs
from p2gs_jax.losses.total import OBSERVED_FORMS
from p2gs_jax.photometry.appearance import identity
from p2gs_jax.photometry.calibrate import calibrate_observations, options_of
from p2gs_jax.photometry.formation import inverse_tone_map
from p2gs_jax.photometry.models import ModelName
from p2gs_jax.photometry.observations import Observations, overlapping_views, sample_pairs
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.selection import Selection
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.photometry.sources import has_tracks, surface_colors
from p2gs_jax.photometry.sources.sampling import sample
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.visibility import shown_share
from p2gs_jax.types import GAMMA_SRGB, Gaussians, Params, Photometry, Scene

PAIR_POOL = 200_000
# Views that share this many points are worth comparing through depth.
FEWEST_SHARED = 30
# Shell colours come from small images: a direction covers many pixels.
SHELL_SHRINK = 4
SHELL_OPACITY = 0.5
# Seeds may take this share of the bound on the population; the rest grows where it is needed.
DENSE_SHARE = 0.6
# Of a time budget at most this share goes into them, if two idle cores need so long for a view.
DENSE_TIME, DENSE_SECONDS, FEWEST_DENSE_VIEWS = 0.25, 0.6, 8
# Scenes with this share of the bound in seeds need no more.
ENOUGH_SEEDS = 0.5


@dataclass
class Prepared:
    """Everything known before the first optimisation step.

    Attributes:
        scene: views, points, tracks.
        store: photographs.
        params: initial parameters.
        extent: scene extent, scene units.
        selection: photometric model, exposures and their errors from the tracks, or None.
        pairs: corresponding observations, or None.
        overlaps: for every training view the ones that show the same surfaces, or None.
        coverage: how much of the scene the views show.
        cfg: the configuration, adapted to what the scene offers.
        notes: what the user should know.
    """

    scene: Scene
    store: ImageStore
    params: Params
    extent: float
    selection: Selection | None
    pairs: ColorPairs | None
    overlaps: list[np.ndarray] | None
    coverage: Coverage
    cfg: FitConfig
    notes: list[str] = field(default_factory=list)


class Expected(NamedTuple):
    """What is known of a fit before its exposures: enough to compile for.

    Attributes:
        store: photographs.
        params: of the right shapes; the Gaussians are the scene's points, without colours.
        extent: scene extent, scene units.
        coverage: how much of the scene the views show.
        cfg: the configuration that most fits end up with.
        images: its tone curve is chosen.
    """

    store: ImageStore
    params: Params
    extent: float
    coverage: Coverage
    cfg: FitConfig
    images: bool


def load(scene_dir: Path, run_dir: Path, cfg: FitConfig, reporter: Reporter) -> Scene:
    """Read a scene of any known format and check that there is something to fit.

    Raises:
        UserError: it cannot be read, or has fewer than two training views or no seed points.
    """
    reporter.stage("Reading the scene")
    scene = load_scene(scene_dir, cfg.data, run_dir / "cache", reporter.message)
    if len(scene.train_indices) < 2:
        raise UserError(
            f"{scene_dir} has {len(scene.train_indices)} training view(s); a fit needs two.",
            fix="add photographs, or hold out fewer with --test-every 0",
        )
    if len(scene.points) == 0:
        raise UserError(
            f"{scene_dir} has no seed points.",
            fix="check the poses and that the photographs overlap",
        )
    return scene


def prepare(
    scene: Scene,
    cfg: FitConfig,
    reporter: Reporter,
    clock: Stopwatch | None = None,
    on_expected: Callable[[Expected], None] = lambda expected: None,
    *,
    reasons: Sequence[str] = (),
) -> Prepared:
    """Start exposures, radiances and Gaussians from what the scene offers.

    Args:
        scene: from `load`.
        cfg: everything.
        reporter: receives progress.
        clock: receives the seconds of `photometry` and `seeds`.
        on_expected: receives what can be told before the exposures are solved, where that is much.
        reasons: for model and curve, where they were chosen before and `cfg` has them.
    """
    clock = clock or Stopwatch()
    begin = time.monotonic()
    store = ImageStore(scene.views, cfg.data)
    views = [scene.views[i] for i in scene.train_indices]
    notes = list(scene.notes)
    extent = scene_extent(views, scene.points)
    tracks: Observations | None = None
    selection: Selection | None = None
    coverage = coverage_of(scene, store)
    dense = wants_dense(scene, coverage, cfg)
    bound = cfg.densify.max_gaussians
    most = min(cfg.init.max_seeds, bound) if isinstance(bound, int) else cfg.init.max_seeds
    keep = subsample(len(scene.points), most, cfg.train.seed)
    points = scene.points[keep]
    expected: Expected | None = None
    likely = _likely(cfg, has_tracks(scene) or dense)
    # Dense seeds cover some of what the points do not.
    shell = None if dense else find_shell(views, scene.points, extent, cfg.init)
    if likely is not None:
        black = gaussians_from_points(points, np.zeros_like(points), views, cfg)
        if shell is not None:
            black = merge(
                black,
                gaussians_from_points(
                    shell.points, np.zeros_like(shell.points), views, cfg, scales=shell.scales
                ),
            )
        params = Params(
            black,
            _photometry(None, len(views), cfg),
            _appearance(len(views), cfg),
        )
        expected = Expected(store, params, extent, coverage, likely, not cfg.photometry.select)
        on_expected(expected)

    def chosen(model: ModelName, response: Response) -> None:
        if expected is not None:
            known = with_choice(expected.cfg, model, response)
            on_expected(expected._replace(cfg=known, images=True))

    if has_tracks(scene) or cfg.photometry.start == "tracks" or dense:
        if not has_tracks(scene):
            notes.append("No tracks: seed points are projected into the views instead.")
        tracks = surface_colors(
            scene, store, cfg.train.seed, lambda i, n: reporter.stage("Sampling colours", i, n)
        )
    if cfg.photometry.start == "tracks":
        if tracks is not None and len(tracks.points):
            reporter.stage("Photometric bundle adjustment")
            selection = calibrate_observations(tracks, options_of(cfg, scene), chosen)
            if reasons:
                selection = dataclasses.replace(selection, reasons=tuple(reasons))
            notes += [*selection.reasons, *selection.solution.warnings]
            cfg = with_selection(cfg, selection)
        else:
            notes.append(
                "No point is seen twice: exposures start at 1 and are learned from the first step."
            )
            cfg = without_tracks(cfg)
    cfg = with_correspondence(cfg, tracks is not None and len(tracks.points) > 0)
    start = None if selection is None else selection.solution
    photometry = _photometry(start, len(views), cfg)
    solved = time.monotonic()
    clock.add("photometry", solved - begin)
    if len(keep) < len(scene.points):
        option = "--gaussians" if most == bound else "--init.max-seeds"
        notes.append(f"{len(scene.points)} seed points were thinned to {len(keep)} ({option}).")
    radiance = _seed_radiance(scene, start, cfg)[keep]
    if dense:
        match = (
            rough_tones(tracks, len(views))
            if start is None
            else Tones.of(start.log_exposures, start.gammas, cfg.photometry)
        )
        added = _dense(scene, store, match, points, photometry, coverage, cfg, reporter)
        gaussians = _seed_gaussians(points, radiance, added, views, cfg)
        covering = np.concatenate([scene.points, added.points])
        shell = find_shell(views, covering, extent, cfg.init)
        notes.append(added.note())
    else:
        gaussians = gaussians_from_points(points, radiance, views, cfg)
    if shell is not None:
        gaussians = merge(gaussians, _shell_gaussians(shell, scene, store, photometry, views, cfg))
        notes.append(
            f"{shell.empty_fraction:.0%} of the images look past every seed point: a far shell "
            f"of {len(shell.points)} Gaussians was added (--init.shell off leaves it out)."
        )
    if isinstance(bound, int) and gaussians.capacity > bound:
        kept = subsample(gaussians.capacity, bound, cfg.train.seed, Stream.SEED_GAUSSIANS)
        notes.append(f"{gaussians.capacity} Gaussians were thinned to {bound} (--gaussians).")
        gaussians = jax.tree.map(lambda a: on_device(np.asarray(a)[kept]), gaussians)
    for note in notes:
        reporter.message(note)
    clock.add("seeds", time.monotonic() - solved)
    return Prepared(
        scene,
        store,
        Params(gaussians, photometry, _appearance(len(views), cfg)),
        extent,
        selection,
        _pairs(tracks, cfg),
        _overlaps(tracks, cfg),
        coverage,
        cfg,
        notes,
    )


def coverage_of(scene: Scene, store: ImageStore) -> Coverage:
    """Return how much of a scene its training views show; the largest counts."""
    sizes = [store.camera(i)[2:] for i in scene.train_indices]
    views = [scene.views[i] for i in scene.train_indices]
    return Coverage(max(w * h for w, h in sizes), shown_share(scene.points, views))


def seed_bound(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return the bound on the population that the seeds are measured by.

    Args:
        cfg: the bound, if it is given.
        seeds: points of the scene.
        coverage: by the training photographs.
    """
    given = cfg.densify.max_gaussians
    if isinstance(given, int):
        return given
    return default_max_gaussians(seeds, coverage, cfg.train)


def dense_limit(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return how many dense seeds a fit may start from.

    Args:
        cfg: the bound on the population and `init.dense_points`.
        seeds: that are there already.
        coverage: by the training photographs.
    """
    bound = seed_bound(cfg, seeds, coverage)
    room = bound - seeds
    wanted = cfg.init.dense_points
    if wanted is None:
        wanted = int(DENSE_SHARE * bound) - seeds
    elif not isinstance(cfg.densify.max_gaussians, int):
        room = wanted
    return max(0, min(wanted, room))


def wants_dense(scene: Scene, coverage: Coverage, cfg: FitConfig) -> bool:
    """Return whether the scene gets dense seeds.

    The baselines that splat display values get them as well: a comparison with them is about
    photometry, so all start from the same surfaces.
    """
    if cfg.init.dense == "off" or len(scene.train_indices) < FEWEST_VIEWS:
        return False
    seeds = min(len(scene.points), cfg.init.max_seeds)
    if dense_limit(cfg, seeds, coverage) == 0:
        return False
    bound = seed_bound(cfg, seeds, coverage)
    return cfg.init.dense == "on" or seeds < ENOUGH_SEEDS * bound


def _dense(
    scene: Scene,
    store: ImageStore,
    match: Tones,
    points: np.ndarray,
    photometry: Photometry,
    coverage: Coverage,
    cfg: FitConfig,
    reporter: Reporter,
) -> DenseSeeds:
    """Find dense seeds, with radiances in the gauge of the exposures that the fit starts from."""
    raw, gammas = np.asarray(photometry.raw_exposures), np.asarray(photometry.raw_gammas)
    most_views, budget = MOST_VIEWS, cfg.train.budget_s
    if budget is not None:
        affordable = int(DENSE_TIME * budget / DENSE_SECONDS)
        most_views = min(most_views, max(affordable, FEWEST_DENSE_VIEWS))
    if photometry.parameterization == "log":
        log_exposures, gammas = raw, GAMMA_SRGB * np.exp(gammas)
    else:
        log_exposures = np.log(raw)
    return dense_seeds(
        scene,
        store,
        match,
        Tones.of(log_exposures, gammas, cfg.photometry),
        cfg,
        existing=points,
        limit=dense_limit(cfg, len(points), coverage),
        most_views=most_views,
        on_view=lambda i, n: reporter.stage("Matching photographs", i, n),
    )


def _seed_gaussians(
    points: np.ndarray, radiance: np.ndarray, dense: DenseSeeds, views, cfg: FitConfig
) -> Gaussians:
    """Return Gaussians of the scene's points and of dense seeds, the former first.

    A point that has dense seeds around it is as small as they are near.
    """
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


def with_choice(cfg: FitConfig, model: ModelName, response: Response) -> FitConfig:
    """Return the configuration under a model and a curve."""
    chosen = dataclasses.replace(
        cfg.photometry, model=model, curve=response.curve, spline=response.spline
    )
    return dataclasses.replace(cfg, photometry=chosen)


def with_selection(cfg: FitConfig, selection: Selection) -> FitConfig:
    """Return the configuration under the chosen model and curve.

    Known exposures that are to be kept are not learned, and no regulariser pulls at their mean.
    """
    p = cfg.photometry
    cfg = with_choice(cfg, selection.solution.model, selection.solution.response)
    if p.known is None:
        return cfg
    regularizers = dataclasses.replace(cfg.loss.regularizers, log_exposure_mean=None)
    frozen = 1.0 if p.known_deviation_ev == 0 else p.freeze_until
    return dataclasses.replace(
        cfg,
        loss=dataclasses.replace(cfg.loss, regularizers=regularizers),
        photometry=dataclasses.replace(cfg.photometry, freeze_until=frozen),
    )


def with_correspondence(cfg: FitConfig, found: bool) -> FitConfig:
    """Return the configuration with a way to compare photographs that the scene allows.

    Args:
        cfg: before; a way that is given stays.
        found: there are colours of shared points.
    """
    relative = cfg.loss.relative_exposure
    if relative.correspondence is not None:
        return cfg
    relative = dataclasses.replace(relative, correspondence="tracks" if found else "depth")
    return dataclasses.replace(cfg, loss=dataclasses.replace(cfg.loss, relative_exposure=relative))


def _likely(cfg: FitConfig, matched: bool) -> FitConfig | None:
    """Return the configuration that a fit probably has once exposures are solved; None: who knows.

    Args:
        cfg: before.
        matched: colours of shared points will be there.
    """
    p, d = cfg.photometry, cfg.densify
    slots_known = d.method == "mcmc" and d.max_gaussians != "auto"
    if p.known is not None or cfg.loss.relative_exposure.weight is not None or not slots_known:
        return None
    if p.start == "tracks" and p.select:
        cfg = dataclasses.replace(cfg, photometry=dataclasses.replace(p, model="view_exposure"))
    return with_correspondence(cfg, matched or p.start == "tracks")


def without_tracks(cfg: FitConfig) -> FitConfig:
    """Return the configuration for exposures that must be learned from nothing.

    They move from the first step, ten times as fast (docs/photometry.md, 4).
    """
    o = cfg.optimizer
    return dataclasses.replace(
        cfg,
        photometry=dataclasses.replace(cfg.photometry, freeze_until=0.0),
        optimizer=dataclasses.replace(o, exposures=10 * o.exposures, gammas=10 * o.gammas),
    )


def _photometry(start: PhotometricSolution | None, count: int, cfg: FitConfig) -> Photometry:
    p = cfg.photometry
    if start is not None:
        log_exposures = np.asarray(start.log_exposures)
    elif p.start == "random":
        draws = generator(cfg.train.seed, Stream.START_EXPOSURES).normal(1.0, p.start_std, count)
        log_exposures = np.log(np.maximum(draws, 0.1))
    else:
        log_exposures = np.zeros(count)
    gammas = np.full(count, GAMMA_SRGB) if start is None else start.gammas
    if p.parameterization == "log":
        exposures, gammas = log_exposures, np.log(gammas / GAMMA_SRGB)
    else:
        exposures = np.exp(log_exposures)
    return Photometry(on_device(exposures), on_device(gammas), p.parameterization)


def _appearance(count: int, cfg: FitConfig):
    kind = cfg.photometry.appearance
    return None if kind is None else identity(kind, count)


def _linearize(colors: np.ndarray, cfg: FitConfig, gamma: float = GAMMA_SRGB) -> np.ndarray:
    return inverse_tone_map(np.asarray(colors, np.float32), np.float32(gamma), cfg.photometry)


def _seed_radiance(scene: Scene, start: PhotometricSolution | None, cfg: FitConfig) -> np.ndarray:
    """Return linear radiance per seed: from the track start where it knows, else from colours."""
    radiance = _linearize(scene.point_colors.astype(np.float32) / 255.0, cfg)
    if start is not None:
        known = np.exp(start.point_log_radiance)
        radiance = np.where(np.isfinite(known), known, radiance)
    return radiance.astype(np.float32)


def _shell_gaussians(
    shell: Shell, scene: Scene, store: ImageStore, photometry: Photometry, views, cfg: FitConfig
) -> Gaussians:
    """Colour the shell by what the photographs show in its directions."""
    taken: Photometry = jax.tree.map(np.asarray, photometry)
    exposures, gammas = taken.exposures, taken.gammas
    total = np.zeros((len(shell.points), 3))
    weight = np.zeros(len(shell.points))
    for row, index in enumerate(scene.train_indices):
        seen = np.flatnonzero(shell.seen[:, row])
        if not len(seen):
            continue
        ldr, mask = store.get(index, SHELL_SHRINK)
        view = scene.views[index]
        scale = [mask.shape[1] / view.width, mask.shape[0] / view.height]
        colors, _, valid = sample(ldr, mask, shell.xy[seen, row] * scale)
        linear = _linearize(colors[valid], cfg, float(gammas[row]))
        total[seen[valid]] += linear / exposures[row]
        weight[seen[valid]] += 1
    seen = weight > 0
    radiance = total[seen] / weight[seen, None]
    return gaussians_from_points(
        shell.points[seen],
        radiance.astype(np.float32),
        views,
        cfg,
        scales=shell.scales[seen],
        opacity=SHELL_OPACITY,
    )


def _compares_photographs(cfg: FitConfig, correspondence: str) -> bool:
    """Return whether the relative-exposure loss compares photographs in the given way."""
    relative = cfg.loss.relative_exposure
    observed = relative.weight is not None and relative.form in OBSERVED_FORMS
    return observed and relative.correspondence == correspondence


def _overlaps(tracks: Observations | None, cfg: FitConfig) -> list[np.ndarray] | None:
    """Return which views to compare through depth: those that share enough points."""
    if tracks is None or not len(tracks.points) or not _compares_photographs(cfg, "depth"):
        return None
    return overlapping_views(tracks, FEWEST_SHARED)


def _pairs(tracks: Observations | None, cfg: FitConfig) -> ColorPairs | None:
    if not _compares_photographs(cfg, "tracks"):
        return None
    if tracks is None or not len(tracks.points):
        raise UserError(
            "the relative-exposure loss was to compare photographs at tracks, and this scene has "
            "none.",
            fix="use --loss.relative-exposure.correspondence depth, or a scene with tracks",
        )
    first, second = sample_pairs(tracks, PAIR_POOL, cfg.train.seed)
    return ColorPairs(
        on_device(tracks.colors[first]),
        on_device(tracks.colors[second]),
        on_device(tracks.views[first], np.int32),
        on_device(tracks.views[second], np.int32),
        on_device(np.ones(len(first))),
    )
