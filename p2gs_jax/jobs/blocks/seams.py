"""Seams between blocks: differences of radiance and depth, and the merged scene.

The blocks at a boundary render the same views. The median difference is a step; the rest is the
difference between any two fits (experiments/results/2026-11-23-districts.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import evenly_spaced, on_device
from p2gs_jax.errors import UserError
from p2gs_jax.jobs.blocks.cut import Cut
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.warp import unproject
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import Camera, Gaussians, Render, Scene

# Largest number of rendered views of a boundary. A step of 0.005 stops read 0.018 with 12 views.
MOST_VIEWS = 48
# Pixels are compared where both blocks have at least this opacity.
OPAQUE = 0.9
DARKEST = 1e-3  # share of the median radiance; darker pixels count as this
# A view with fewer pixels of the strip is ignored.
FEWEST_PIXELS = 50


@dataclass(frozen=True)
class Seam:
    """Differences of two blocks in the strip around their boundary; None without comparisons.

    The step of radiance is visible as a seam.
    """

    blocks: tuple[int, int]  # numbers of the blocks
    views: int  # number of views that show the strip
    pixels: int  # number of compared pixels
    step_stops: float | None = None  # median ratio of radiance, second to first, stops
    spread_stops: float | None = None  # median absolute value of that ratio, stops
    step_depth: float | None = None  # median ratio of depth, second to first, minus 1
    spread_depth: float | None = None  # median absolute value of that difference


def measure_seams(
    scene: Scene, store: ImageStore, cut: Cut, fitted: Sequence[Gaussians], cfg: RenderConfig
) -> list[Seam]:
    """Compare neighbouring blocks, with all Gaussians of each, in their common training views.

    Only the cameras of the photographs are used. Radiance is compared as rendered: divided by the
    opacity, a block that shows 1 % of the background would look 0.014 stop brighter.
    """
    seams = []
    for pair in cut.neighbours():
        first, second = (cut.blocks[k] for k in pair)
        both = sorted(set(first.views) & set(second.views))
        fits = [fitted[k] for k in pair]
        renderers = [partial(make_renderer(cfg), g, g.all_alive) for g in fits]
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


def _compared(
    camera: Camera, cut: Cut, pair: tuple[int, int], renderers: list[Callable[[Camera], Render]]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return log2 ratios of radiance and relative differences of depth for pixels of the strip."""
    renders = []
    for render in renderers:
        drawn = render(camera)
        linear, alpha = np.asarray(drawn.linear), np.asarray(drawn.alpha)
        assert drawn.depth is not None
        depth = np.asarray(drawn.depth) / np.maximum(alpha, 1e-6)
        renders.append((linear.mean(-1), depth, alpha))
    (radiance, depth, alpha), (other, other_depth, other_alpha) = renders
    # A choice by one of the two depths would favour pixels in which that depth is wrong.
    middle = np.sqrt(np.maximum(depth * other_depth, 0.0))
    points = unproject(middle, jax.tree.map(np.asarray, camera))
    places = cut.ground.place(points.reshape(-1, 3))
    strip = np.ones(len(places), bool)
    for number in pair:
        strip &= cut.blocks[number].holds(places, cut.margin)
    good = strip.reshape(depth.shape) & (alpha > OPAQUE) & (other_alpha > OPAQUE)
    good &= (depth > 0) & (other_depth > 0)
    both = np.stack([radiance[good], other[good]])
    both = np.maximum(both, DARKEST * np.median(both)) if both.size else both
    return np.log2(both[1] / both[0]), other_depth[good] / depth[good] - 1


def merge_cores(cut: Cut, fitted: Sequence[Gaussians]) -> tuple[Gaussians, list[int]]:
    """Return the Gaussians with centres in the core of their block, and their number per block.

    They are ordered by block. Cores cover space exactly once, so that no part of the scene is
    missing or doubled. UserError: no block has a Gaussian in its core.
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
