"""Slots: allocation, growth and the moves that all densification methods share.

The arrays keep their shape inside jit; only `grow`, on the host and between steps, enlarges them.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import TrainConfig
from p2gs_jax.types import Gaussians, Population

# Opacity logit of empty slots: below every cutoff.
EMPTY_LOGIT = -20.0
GROWTH_BUCKET = 1.5


class Outcome(NamedTuple):
    """The result of a densification."""

    gaussians: Gaussians
    population: Population
    reset_moments: Bool[Array, " n"]  # slots whose optimiser moments must be zeroed
    refused: Int[Array, ""]  # requests for which there was no slot: counted, never silent


def fresh_population(alive: Bool[Array, " n"], owner: Int[Array, " n"] | None = None) -> Population:
    """Return a population with empty statistics; `owner` is the moving object of each Gaussian."""
    # Two arrays, not one twice: the step donates its input, and a buffer can be donated once only.
    none = [jnp.zeros(alive.shape, jnp.float32) for _ in range(2)]
    return Population(alive, *none, owner=owner)


def empty_population(count: int, like: Population) -> Population:
    """Return the population of `count` empty slots, which are nobody's."""
    owner = None if like.owner is None else jnp.full(count, -1, like.owner.dtype)
    return fresh_population(jnp.zeros(count, bool), owner)


def empty_gaussians(count: int, like: Gaussians) -> Gaussians:
    """Return harmless contents for `count` empty slots."""
    shape = jax.tree.map(lambda a: jnp.zeros((count, *a.shape[1:]), a.dtype), like)
    return dataclasses.replace(
        shape,
        quats=shape.quats.at[:, 0].set(1.0),
        opacity_logits=jnp.full((count,), EMPTY_LOGIT, like.opacity_logits.dtype),
    )


# Seconds of a step per pixel, and of the shortest step: two cores of 2025; an H200 (2026-11-26).
STEP_SECONDS = {"cpu": (5e-7, 0.0), "gpu": (4e-9, 4e-3)}
# Gaussians shown per pixel of a view: from the first to the second with the steps of a run (ours:
# BUILD_NOTES, "Population").
SMALLEST_SHARE, LARGEST_SHARE, STEPS_PER_SHARE = 0.1, 0.3, 15_000
MOST_BY_DEFAULT = 400_000


class Coverage(NamedTuple):
    """Pixels of one view, and the share of the scene that a view shows on average."""

    pixels: int
    shown: float

    def gaussians(self, steps: float | int) -> int:
        """Return how many Gaussians so many steps can fit."""
        share = min(max(steps / STEPS_PER_SHARE, SMALLEST_SHARE), LARGEST_SHARE)
        return int(share * self.pixels / self.shown)


def step_seconds(pixels: int) -> float:
    """Return about how long a step takes on the default device for a view of so many pixels."""
    each, least = STEP_SECONDS.get(jax.default_backend(), STEP_SECONDS["cpu"])
    return max(each * pixels, least)


def default_max_gaussians(seeds: int, coverage: Coverage, train: TrainConfig) -> int:
    """Return the population limit where none is configured.

    A long run can fit more Gaussians than a short one, and a scene of which a view shows little
    needs more. The limit is never below the seeds and a quarter.
    """
    steps = train.steps
    if train.budget_s is not None:
        steps = train.budget_s / step_seconds(coverage.pixels)
    wanted = min(coverage.gaussians(steps), MOST_BY_DEFAULT)
    return max(int(1.25 * seeds), wanted, 1000)


def bucket_for(needed: int, current: int, limit: int | None) -> int:
    """Return the capacity to grow to: at least `needed`, in steps of 1.5, at most `limit`."""
    capacity = current
    while capacity < needed:
        capacity = int(capacity * GROWTH_BUCKET) + 256
    return capacity if limit is None else max(min(capacity, limit), needed)


def grow(tree, fill):
    """Append the slots of `fill` to every array of `tree`."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), tree, fill)


def place(
    requests: Bool[Array, " n"], alive: Bool[Array, " n"]
) -> tuple[Int[Array, " n"], Int[Array, ""]]:
    """Assign an empty slot to each request, in order; count the requests that found none.

    A request without a slot gets n, out of bounds.
    """
    n = alive.shape[0]
    rank = jnp.cumsum(requests) - 1
    room = n - jnp.sum(alive)
    granted = requests & (rank < room)
    free = jnp.argsort(alive, stable=True).astype(jnp.int32)  # empty slots first, in order
    slot = jnp.where(granted, free[jnp.clip(rank, 0, n - 1)], n)
    return slot, jnp.sum(requests) - jnp.sum(granted)


def opacities(gaussians: Gaussians) -> Float[Array, " n"]:
    """Return peak opacities in (0, 1)."""
    return jax.nn.sigmoid(gaussians.opacity_logits)


def logit(p: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return log(p / (1 - p)), with p kept off 0 and 1."""
    p = jnp.clip(p, 1e-6, 1 - 1e-6)
    return jnp.log(p) - jnp.log1p(-p)
