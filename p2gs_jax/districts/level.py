"""Blocks agree where they meet: their radiance is moved towards each other, less and less inwards.

Exposures drift along a drive by some thousandths of a stop a block, and each block's radiance
follows those of its own photographs. What is left as a step at a boundary is spread over the
blocks beside it, as seams of textures are levelled (Lempitsky and Ivanov 2007; Waechter et al.
2014); docs/districts.md says what that does and what it does not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.districts.cut import OVERLAP, Cut
from p2gs_jax.districts.seams import Seam, measure_seams
from p2gs_jax.render.harmonics import scaled
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Gaussians, Scene

# How far into a core its radiance is moved, as a share of the shortest core.
INWARDS = 0.5


def level_seams(
    scene: Scene, store: ImageStore, cut: Cut, fitted: Sequence[Gaussians], cfg: RenderConfig
) -> tuple[list[Gaussians], list[Seam]]:
    """Take steps between blocks out, and say what is left of them.

    Every second view of a boundary tells the step, the others judge: what is left is measured where
    nothing was fitted to.

    Args:
        scene: the whole.
        store: its photographs; only their cameras are used.
        cut: of the scene.
        fitted: all Gaussians of each block.
        cfg: rendering options.

    Returns:
        All Gaussians of each block, and its seams, with what was taken out of each.
    """
    told = measure_seams(scene, store, cut, fitted, cfg, which=slice(0, None, 2))
    steps = {s.blocks: s.step_stops for s in told if s.step_stops is not None}
    levelled = []
    for number, gaussians in enumerate(fitted):
        shift = shifts(cut, number, np.asarray(gaussians.means), steps) * np.log(2)
        sh = scaled(np.asarray(gaussians.sh), shift[:, None], cfg.radiance)
        levelled.append(dataclasses.replace(gaussians, sh=on_device(sh)))
    left = measure_seams(scene, store, cut, levelled, cfg, which=slice(1, None, 2))
    return levelled, [dataclasses.replace(s, levelled_stops=steps.get(s.blocks)) for s in left]


def shifts(
    cut: Cut,
    number: int,
    means: Float[np.ndarray, "n 3"],
    steps: Mapping[tuple[int, int], float],
) -> Float[np.ndarray, " n"]:
    """Return by how many stops a block's radiance is to grow at some places.

    Where several blocks are near, their radiance becomes the mean of what each has, with weights
    that fall with the distance from its core: two blocks come out alike wherever no third is near,
    and a block's own radiance stays where none is.

    Args:
        cut: of the scene.
        number: of the block.
        means: places, scene units.
        steps: second block over first, stops; pairs without one have no part in each other's mean.
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
