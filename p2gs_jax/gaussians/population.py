"""Slots for Gaussians: allocation, growth, and helpers that all densification methods share.

The arrays keep their shape inside jit; only `grow`, on the host and between steps, enlarges them.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import FitConfig, TrainConfig
from p2gs_jax.types import Gaussians, Population

# Opacity logit of empty slots: below every cutoff.
EMPTY_LOGIT = -20.0
GROWTH_BUCKET = 1.5  # ratio of consecutive capacities


class Outcome(NamedTuple):
    """The result of a densification."""

    gaussians: Gaussians
    population: Population
    reset_moments: Bool[Array, " n"]  # slots whose optimiser moments must be zeroed
    refused: Int[Array, ""]  # requests for which there was no free slot


def fresh_population(alive: Bool[Array, " n"], owner: Int[Array, " n"] | None = None) -> Population:
    """Return a population with zero statistics; `owner` is the object of a Gaussian, -1: none."""
    # Two separate arrays: a step donates its input, and a buffer can be donated only once.
    zeros = [jnp.zeros(alive.shape, jnp.float32) for _ in range(2)]
    return Population(alive, *zeros, owner=owner)


def empty_population(count: int, like: Population) -> Population:
    """Return the population of `count` empty slots, which belong to no moving object."""
    owner = None if like.owner is None else jnp.full(count, -1, like.owner.dtype)
    return fresh_population(jnp.zeros(count, bool), owner)


def empty_gaussians(count: int, like: Gaussians) -> Gaussians:
    """Return invisible Gaussians for `count` empty slots."""
    zeros = jax.tree.map(lambda a: jnp.zeros((count, *a.shape[1:]), a.dtype), like)
    return dataclasses.replace(
        zeros,
        quats=zeros.quats.at[:, 0].set(1.0),
        opacity_logits=jnp.full((count,), EMPTY_LOGIT, like.opacity_logits.dtype),
    )


# Seconds of a step per pixel, and least seconds of a step: two CPU cores (2025), an H200 (2026).
STEP_SECONDS = {"cpu": (5e-7, 0.0), "gpu": (4e-9, 4e-3)}
# Visible Gaussians per pixel of a view: the steps of a run / STEPS_PER_SHARE, within these bounds
# (ours: BUILD_NOTES, "Population").
SMALLEST_SHARE, LARGEST_SHARE, STEPS_PER_SHARE = 0.1, 0.3, 15_000
MOST_BY_DEFAULT = 400_000  # Gaussians


class Coverage(NamedTuple):
    """Pixels of one view, and the share of the scene that a view shows on average."""

    pixels: int
    visible_share: float

    def gaussians(self, steps: float | int) -> int:
        """Return the number of Gaussians that a run of `steps` steps can fit."""
        share = min(max(steps / STEPS_PER_SHARE, SMALLEST_SHARE), LARGEST_SHARE)
        return int(share * self.pixels / self.visible_share)


def step_seconds(pixels: int) -> float:
    """Return the estimated seconds of a step on the default device, for a view of `pixels`."""
    per_pixel, least = STEP_SECONDS.get(jax.default_backend(), STEP_SECONDS["cpu"])
    return max(per_pixel * pixels, least)


def default_max_gaussians(seeds: int, coverage: Coverage, train: TrainConfig) -> int:
    """Return the limit of the population if the configuration sets none.

    A longer run can fit more Gaussians. A scene needs more Gaussians if a view shows a smaller
    share of it. The limit is at least 1.25 times the number of seeds and at least 1,000.
    """
    steps = train.steps
    if train.budget_s is not None:
        steps = train.budget_s / step_seconds(coverage.pixels)
    wanted = min(coverage.gaussians(steps), MOST_BY_DEFAULT)
    return max(int(1.25 * seeds), wanted, 1000)


def seed_bound(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return the bound on the population of a fit with this number of seeds."""
    limit = cfg.densify.max_gaussians
    return default_max_gaussians(seeds, coverage, cfg.train) if limit is None else limit


def bucket_for(needed: int, current: int) -> int:
    """Return a capacity of at least `needed`, grown by factors of about 1.5."""
    capacity = current
    while capacity < needed:
        capacity = int(capacity * GROWTH_BUCKET) + 256
    return capacity


def grow(tree, fill):
    """Append the slots of `fill` to every array of `tree`."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), tree, fill)


def place(
    requests: Bool[Array, " n"], alive: Bool[Array, " n"]
) -> tuple[Int[Array, " n"], Int[Array, ""]]:
    """Assign an empty slot to each request, in order; count the requests without a slot.

    A request without a slot gets n, which is out of bounds.
    """
    n = alive.shape[0]
    rank = jnp.cumsum(requests) - 1
    granted = requests & (rank < n - jnp.sum(alive))
    free = jnp.argsort(alive, stable=True).astype(jnp.int32)  # empty slots first, in order
    slot = jnp.where(granted, free[jnp.clip(rank, 0, n - 1)], n)
    return slot, jnp.sum(requests) - jnp.sum(granted)


def opacities(gaussians: Gaussians) -> Float[Array, " n"]:
    """Return the opacities, in (0, 1)."""
    return jax.nn.sigmoid(gaussians.opacity_logits)


def logit(p: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return log(p / (1 - p)), with p clipped to [1e-6, 1 - 1e-6]."""
    p = jnp.clip(p, 1e-6, 1 - 1e-6)
    return jnp.log(p) - jnp.log1p(-p)
