"""Densification of 3DGS, as in the paper: clone small, split large, prune, reset opacities."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from p2gs_jax.config import DensifyConfig
from p2gs_jax.gaussians.population import Outcome, fresh_population, opacities, place
from p2gs_jax.render.project import rotated, rotation_matrices
from p2gs_jax.types import Gaussians, Population

SPLIT_SHRINK = 1.6  # divisor of the scales in a split (3DGS)
RESET_OPACITY = 0.01  # largest opacity after a reset (3DGS)


class Proposal(NamedTuple):
    """The Gaussians that one densification prunes, clones and splits, before slots are assigned."""

    prune: Bool[Array, " n"]
    clone: Bool[Array, " n"]
    split: Bool[Array, " n"]
    wanted: Int[Array, ""]  # number of slots needed: survivors plus children


def propose(
    gaussians: Gaussians,
    population: Population,
    extent: Float[Array, ""] | float,
    prune_large: Bool[Array, ""] | bool,
    cfg: DensifyConfig,
) -> Proposal:
    """Choose the Gaussians to prune, clone and split, from statistics since the last densification.

    `extent` is the scene extent in scene units. `prune_large` also prunes oversized Gaussians
    (3DGS: after the first opacity reset).
    """
    largest = jnp.exp(jnp.max(gaussians.log_scales, -1))
    prune = opacities(gaussians) < cfg.prune_opacity
    oversized = largest > cfg.prune_scale * extent
    prune = population.alive & (prune | (prune_large & oversized))
    average = population.grad2d_sum / jnp.maximum(population.seen_count, 1)
    hot = population.alive & ~prune & (average >= cfg.grad_threshold)
    small = largest <= cfg.clone_scale * extent
    clone, split = hot & small, hot & ~small
    survivors = jnp.sum(population.alive & ~prune)
    return Proposal(prune, clone, split, survivors + jnp.sum(hot))


def apply(
    key: PRNGKeyArray, gaussians: Gaussians, population: Population, proposal: Proposal
) -> Outcome:
    """Carry out a proposal within the existing slots.

    A clone is an exact copy. A split replaces the parent by two samples from its distribution, with
    scales divided by 1.6 (3DGS). `key` draws the samples.
    """
    alive = population.alive & ~proposal.prune
    requests = proposal.clone | proposal.split
    slot, refused = place(requests, alive)
    split = proposal.split & (slot < alive.shape[0])
    scales, s = jnp.exp(gaussians.log_scales), split[:, None]
    R = rotation_matrices(gaussians.quats)
    shrunk = gaussians.log_scales - jnp.log(SPLIT_SHRINK)

    def sample(k):
        drawn = gaussians.means + rotated(R, jax.random.normal(k, gaussians.means.shape) * scales)
        return dataclasses.replace(
            gaussians,
            means=jnp.where(s, drawn, gaussians.means),
            log_scales=jnp.where(s, shrunk, gaussians.log_scales),
        )

    parent, child = map(sample, jax.random.split(key))
    gaussians, owner = jax.tree.map(
        lambda a, b: a.at[slot].set(b, mode="drop"),
        (parent, population.owner),
        (child, population.owner),
    )
    born = jnp.zeros_like(alive).at[slot].set(True, mode="drop")
    return Outcome(gaussians, fresh_population(alive | born, owner), born | split, refused)


def reset_opacities(gaussians: Gaussians) -> Gaussians:
    """Lower every opacity to at most 0.01; useful Gaussians become opaque again (3DGS)."""
    ceiling = jnp.log(RESET_OPACITY / (1 - RESET_OPACITY))
    return dataclasses.replace(
        gaussians, opacity_logits=jnp.minimum(gaussians.opacity_logits, ceiling)
    )
