"""Random streams of fits and synthetic scenes, by name; two uses of one stream would be correlated.

The order of views is the exception: its stream is the number of the epoch. Epoch 7, for example,
has the random numbers of `HELD_OUT`; no computation depends on both.
"""

from __future__ import annotations

from enum import IntEnum, unique

import jax
import numpy as np
from jaxtyping import Array, Int, PRNGKeyArray, UInt32


@unique
class Stream(IntEnum):
    """Random choices of a fit on the host, except the order of its views."""

    PARTNER = 1  # second view of a step
    STEP_PAIRS = 2  # track observations that a step compares
    START_EXPOSURES = 3
    COMPARED_POINTS = 5  # points whose observations choose the photometric model
    HELD_OUT = 7  # observations that are held out to compare models
    COLOR_PAIRS = 11  # track observations that steps draw from
    STACK_PIXELS = 13
    SURFACE_COLORS = 17  # points without tracks, and the views in which they are sampled
    SOLVED_POINTS = 19  # points from which exposures are solved
    MATCHED_PIXELS = 23  # pixels of a view that may become dense seeds
    DENSE_SEEDS = 29
    SEED_POINTS = 31  # points of the scene that start as Gaussians
    SEED_GAUSSIANS = 37  # Gaussians of seeds and shell that are kept
    SHARED_POINTS = 41  # points that select the views to match
    RENDERED_PIXELS = 43  # pixels of a fit that are warped into other views
    LIDAR = 53  # LiDAR measurements that are kept
    MEASURED_DEPTHS = 59  # LiDAR measurements in the loss of a view
    RANDOM_SEEDS = 67  # seeds of scenes without points and matches
    BACKDROP = 71  # background of a photograph with alpha in a step
    VIBRATING = 73  # LiDAR points that become vibrating Gaussians
    NETWORK = 79  # initial weights of the network of Luminance-GS
    SELF_CHECK = 83  # Gaussians of the rasterizer's self-check
    SCORE_SIGNS = 47  # signs of residuals for standard errors of many views
    EQUAL_RESIDUALS = 89  # signs of residuals of one size, for the same


@unique
class SceneStream(IntEnum):
    """Random choices of a synthetic scene."""

    BUILDINGS = 1
    ISO = 2
    SEED_POINTS = 3
    CAMERAS = 4
    LIGHT = 5
    PHOTOGRAPH = 6
    OPTICS = 7  # lenses, and the white balance of every photograph


def generator(seed: int, stream: Stream | SceneStream, *more: int) -> np.random.Generator:
    """Return a new generator of a stream, or of a step, view or row in it (`more`)."""
    return np.random.default_rng((seed, int(stream), *more))


def view_order(seed: int, epoch: int, count: int) -> Int[np.ndarray, " v"]:
    """Return the order of `count` views in an epoch."""
    return np.random.default_rng((seed, epoch)).permutation(count)


def device_seed(seed: int) -> np.uint32:
    """Return a seed as an argument of programs, so that all seeds share one program.

    JAX uses the lowest 32 bits of a seed.
    """
    return np.uint32(seed & 0xFFFFFFFF)


def noise_key(seed: UInt32[Array, ""], step: Int[Array, ""]) -> PRNGKeyArray:
    """Return the key of a step's exploration noise, on the device."""
    return jax.random.fold_in(jax.random.key(seed), step)


def densification_key(seed: UInt32[Array, ""], step: Int[Array, ""]) -> PRNGKeyArray:
    """Return the key of the densification after a step, on the device."""
    return jax.random.fold_in(jax.random.key(seed + 1), step)
