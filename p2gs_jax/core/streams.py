"""The random streams of fits and synthetic scenes, by name: users of one would be correlated.

The order of views is the exception: its stream is the number of the epoch, and epoch 7 therefore
has the words of `HELD_OUT`; nothing that is computed depends on both.
"""

from __future__ import annotations

from enum import IntEnum, unique

import jax
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray, UInt32


@unique
class Stream(IntEnum):
    """What a fit draws on the host, beside the order of its views."""

    PARTNER = 1  # second view of a step
    STEP_PAIRS = 2  # track observations that a step compares
    START_EXPOSURES = 3
    COMPARED_POINTS = 5  # points whose observations choose the photometric model
    HELD_OUT = 7  # observations that judge it
    COLOR_PAIRS = 11  # track observations that steps draw from
    STACK_PIXELS = 13
    SURFACE_COLORS = 17  # points without tracks, and the views they are sampled in
    SOLVED_POINTS = 19  # points that exposures are solved from
    MATCHED_PIXELS = 23  # pixels of a view that may become dense seeds
    DENSE_SEEDS = 29
    SEED_POINTS = 31  # points of the scene that start as Gaussians
    SEED_GAUSSIANS = 37  # those of these and of the shell that are kept
    SHARED_POINTS = 41  # points that tell which views to match
    RENDERED_PIXELS = 43  # pixels of a fit that are looked for in other views
    LIDAR = 53  # laser measurements that are kept
    MEASURED_DEPTHS = 59  # laser measurements that a view is compared with
    RANDOM_SEEDS = 67  # seeds of scenes without points and matches
    BACKDROP = 71  # what a step composites a photograph with alpha over
    VIBRATING = 73  # laser points that start as Gaussians that vibrate
    NETWORK = 79  # first weights of the network that reads photographs (Luminance-GS)
    SELF_CHECK = 83  # Gaussians that the rasterizer is checked with
    SCORE_SIGNS = 47  # signs of residuals, from which standard errors of many views are drawn


@unique
class SceneStream(IntEnum):
    """What a synthetic scene draws."""

    BUILDINGS = 1
    ISO = 2
    SEED_POINTS = 3
    CAMERAS = 4
    LIGHT = 5
    PHOTOGRAPH = 6
    OPTICS = 7  # lenses, and the white balance of every photograph


def generator(seed: int, stream: Stream | SceneStream, *more: int) -> np.random.Generator:
    """Return the generator of a stream, and of a step, view or row in it, at its beginning."""
    return np.random.default_rng((seed, int(stream), *more))


def view_order(seed: int, epoch: int, count: int) -> Int[np.ndarray, " v"]:
    """Return the order of so many views in an epoch."""
    return np.random.default_rng((seed, epoch)).permutation(count)


def device_seed(seed: int) -> np.uint32:
    """Return a seed as programs take it: an argument, so that every seed has the same program.

    JAX uses the lowest 32 bits of a seed.
    """
    return np.uint32(seed & 0xFFFFFFFF)


def noise_key(seed: UInt32[Array, ""], step: Int[Array, ""]) -> PRNGKeyArray:
    """Return the key of a step's exploration noise, on the device."""
    return jax.random.fold_in(jax.random.key(seed), step)


def densification_key(seed: UInt32[Array, ""], step: Int[Array, ""]) -> PRNGKeyArray:
    """Return the key of the densification after a step, on the device."""
    return jax.random.fold_in(jax.random.key(seed + 1), step)
