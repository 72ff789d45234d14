"""Where blocks meet: how their radiance and depth differ, made equal, and merged.

The same views are rendered by each block along a boundary. A difference in one direction is a step;
one both ways is what two fits of anything differ by. Exposures drift along a drive by thousandths
of a stop a block, and each block's radiance follows its photographs. The step is spread over the
blocks beside it, less and less inwards, as seams of textures are levelled (Lempitsky and Ivanov
2007; Waechter et al. 2014); docs/scaling.md says what that does and does not do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import evenly_spaced, on_device
from p2gs_jax.errors import UserError
from p2gs_jax.jobs.blocks.cut import OVERLAP, Cut
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.harmonics import scaled
from p2gs_jax.render.warp import unproject
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import Camera, Gaussians, Render, Scene

# Views of a boundary that are rendered at most. With 12 a step was .018 stop, with 48 .005.
MOST_VIEWS = 48
# Where either block shows less, nothing is compared.
OPAQUE = 0.9
DARKEST = 1e-3
# How far into a core its radiance is moved, as a share of the shortest core.
INWARDS = 0.5
# A view with fewer pixels of the strip says little.
FEWEST_PIXELS = 50


@dataclass(frozen=True)
class Seam:
    """How two blocks differ in the strip around their boundary; None where nothing was compared.

    The step of radiance is what one sees as a seam.
    """

    blocks: tuple[int, int]  # their numbers
    views: int  # that show the strip
    pixels: int  # that were compared
    step_stops: float | None = None  # median of the second's radiance over the first's, stops
    spread_stops: float | None = None  # median size of that ratio
    step_depth: float | None = None  # median of the second's depth over the first's, less one
    spread_depth: float | None = None  # median size of that
    levelled_stops: float | None = None  # the step that was taken out before, as other views told


def measure_seams(
    scene: Scene,
    store: ImageStore,
    cut: Cut,
    fitted: Sequence[Gaussians],
    cfg: RenderConfig,
    which: slice,
) -> list[Seam]:
    """Compare neighbouring blocks, by all Gaussians of each, in training views of both.

    Of the photographs only the cameras are used; `which` selects among the views that two blocks
    share, in the order of the scene.
    """
    seams = []
    for pair in cut.neighbours():
        first, second = (cut.blocks[k] for k in pair)
        both = sorted(set(first.views) & set(second.views))[which]
        renderers = [_rendering(fitted[k], cfg) for k in pair]
        rows = (scene.train_indices[both[k]] for k in evenly_spaced(len(both), MOST_VIEWS))
        found = [_compared(camera_of(store, index), cut, pair, renderers) for index in rows]
        found = [parts for parts in found if len(parts[0]) >= FEWEST_PIXELS]
        if not found:
            seams.append(Seam(pair, 0, 0))
            continue
        ratio, depth = map(np.concatenate, zip(*found, strict=True))
        medians = (float(np.median(x)) for x in (ratio, np.abs(ratio), depth, np.abs(depth)))
        seams.append(Seam(pair, len(found), len(ratio), *medians))
    return seams


def _rendering(gaussians: Gaussians, cfg: RenderConfig) -> Callable[[Camera], Render]:
    return partial(make_renderer(cfg), gaussians, jax.numpy.ones(gaussians.capacity, bool))


def _compared(
    camera: Camera, cut: Cut, pair: tuple[int, int], renderers: list[Callable[[Camera], Render]]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return log2 ratios of radiance and relative ones of depth where a view shows the strip."""
    shown = []
    for render in renderers:
        drawn = render(camera)
        linear, alpha = np.asarray(drawn.linear), np.asarray(drawn.alpha)
        assert drawn.depth is not None
        opaque = np.maximum(alpha, 1e-6)
        shown.append((linear.mean(-1) / opaque, np.asarray(drawn.depth) / opaque, alpha))
    (one, near, solid), (other, far, covered) = shown
    # Chosen by one of the depths, pixels would be those in which the other is farther off.
    middle = np.sqrt(np.maximum(near * far, 0.0))
    points = unproject(middle, jax.tree.map(np.asarray, camera))
    places = cut.ground.place(points.reshape(-1, 3))
    strip = np.ones(len(places), bool)
    for number in pair:
        strip &= cut.blocks[number].holds(places, cut.margin)
    good = strip.reshape(near.shape) & (solid > OPAQUE) & (covered > OPAQUE)
    good &= (near > 0) & (far > 0)
    ratio = np.log2(np.maximum(other[good], DARKEST) / np.maximum(one[good], DARKEST))
    return ratio, far[good] / near[good] - 1


def level_seams(
    scene: Scene, store: ImageStore, cut: Cut, fitted: Sequence[Gaussians], cfg: RenderConfig
) -> tuple[list[Gaussians], list[Seam]]:
    """Take steps between blocks out; return their Gaussians, and seams with what was taken out.

    Every second view of a boundary tells the step, the others judge: what is left is measured where
    nothing was fitted to. Arguments are those of `measure_seams`.
    """
    told = measure_seams(scene, store, cut, fitted, cfg, slice(0, None, 2))
    steps = {s.blocks: s.step_stops for s in told if s.step_stops is not None}
    levelled = []
    for number, gaussians in enumerate(fitted):
        shift = shifts(cut, number, np.asarray(gaussians.means), steps) * np.log(2)
        sh = scaled(np.asarray(gaussians.sh), shift[:, None], cfg.radiance)
        levelled.append(replace(gaussians, sh=on_device(sh)))
    left = measure_seams(scene, store, cut, levelled, cfg, slice(1, None, 2))
    return levelled, [replace(s, levelled_stops=steps.get(s.blocks)) for s in left]


def shifts(
    cut: Cut, number: int, means: Float[np.ndarray, "n 3"], steps: Mapping[tuple[int, int], float]
) -> Float[np.ndarray, " n"]:
    """Return by how many stops a block's radiance is to grow at some places (scene units).

    Where several blocks are near, their radiance becomes the mean of what each has, with weights
    that fall with the distance from its core: two blocks come out alike wherever no third is near,
    and a block's own radiance stays where none is. `steps` are of the second block over the first,
    stops; pairs without one have no part in each other's mean.
    """
    places = cut.ground.place(means)
    reach = INWARDS * cut.margin / OVERLAP
    weight = _near(cut.blocks[number].distance(places), reach)
    total, moved = weight.copy(), np.zeros(len(places))
    for (first, second), step in steps.items():
        if number in (first, second):
            other, more = (second, step) if number == first else (first, -step)
            weight = _near(cut.blocks[other].distance(places), reach)
            total += weight
            moved += weight * more
    return moved / np.maximum(total, np.finfo(float).tiny)


def _near(distance: Float[np.ndarray, " n"], reach: float) -> Float[np.ndarray, " n"]:
    return np.maximum(1 - distance / reach, 0.0)


def merge_cores(cut: Cut, fitted: Sequence[Gaussians]) -> tuple[Gaussians, list[int]]:
    """Return the Gaussians whose centres lie in the core of the block that fitted them.

    They stand block after block; also how many each gave. Cores cover space once: nothing is there
    twice, and nothing is left out. UserError: no block has any in its core.
    """
    kept = [
        np.flatnonzero(cut.core(number, np.asarray(gaussians.means)))
        for number, gaussians in enumerate(fitted)
    ]
    counts = [len(rows) for rows in kept]
    if not sum(counts):
        fix = "use fewer --blocks, or more --steps"
        raise UserError("no block has a Gaussian in its core.", fix=fix)

    def joined(*arrays) -> jax.Array:
        parts = [np.asarray(a)[rows] for a, rows in zip(arrays, kept, strict=True)]
        return on_device(np.concatenate(parts))

    return jax.tree.map(joined, *fitted), counts
