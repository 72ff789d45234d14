"""The Gaussians' side of a step: gradients, Adam and noise of what a view shows, block by block.

Each block is read, differentiated, updated and written once, while it lies in the cache; nothing of
the size of the population is ever made.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Int

from p2gs_jax.render.visible import block_size, owners_at, put_rows, slice_of, take_rows
from p2gs_jax.train.optimizer import AdamState
from p2gs_jax.types import Gaussians


class Updated(NamedTuple):
    """Gaussians and their optimiser after a step.

    Attributes:
        gaussians: with the listed ones moved.
        moments: likewise.
        finite: whether the gradient of each array is finite, in the order of `Gaussians`.
    """

    gaussians: Gaussians
    moments: AdamState
    finite: Bool[Array, " f"]


def update_listed(
    gaussians: Gaussians,
    moments: AdamState,
    alive: Bool[Array, " n"],
    ids: Int[Array, " v"],
    count: Int[Array, ""],
    healthy: Bool[Array, ""],
    *,
    bands: int,
    seen: Callable,
    v_seen: Any,
    optimizer: optax.GradientTransformationExtraArgs,
    rates: Gaussians,
    noise: Callable | None,
    owner: Int[Array, " n"] | None = None,
) -> Updated:
    """Move the listed Gaussians by one step.

    Args:
        gaussians: the scene.
        moments: Adam's, of all of them.
        alive: slots in use.
        ids: from `compact`, whole blocks.
        count: how many are listed.
        healthy: otherwise nothing is written.
        bands: spherical-harmonics coefficients that are looked at and moved.
        seen: (Gaussians, alive, owner) of a block -> what the image is made of, per Gaussian.
        v_seen: gradient of the loss to that, for the whole list.
        optimizer: from `make_optimizer`, for the Gaussians.
        rates: learning rates.
        noise: (number of a block, ids, Gaussians, alive) -> what to add to their means, or None.
        owner: the moving object that each Gaussian belongs to, or None.
    """
    n, size = gaussians.capacity, block_size(ids.shape[0])

    def body(k, state: Updated) -> Updated:
        here = slice_of(ids, k, size)
        shown = alive.at[here].get(mode="fill", fill_value=False)
        mine = owners_at(owner, here)
        old = take_rows(state.gaussians, here, bands)

        _, pull = jax.vjp(lambda block: seen(block, shown, mine), old)
        (grads,) = pull(slice_of(v_seen, k, size))
        finite = jnp.stack([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(grads)])
        adam = AdamState(
            state.moments.counts.at[here].get(mode="clip"),
            take_rows(state.moments.mu, here, bands),
            take_rows(state.moments.nu, here, bands),
        )
        # optax annotates trees as nests of containers and does not know our records.
        updates, moved_state = optimizer.update(
            cast(Any, grads), (adam, optax.EmptyState()), cast(Any, old), rates=rates
        )
        new = cast(Any, moved_state)[0]
        moved = cast(Gaussians, optax.apply_updates(cast(Any, old), cast(Any, updates)))
        if noise is not None:
            added = noise(k, here, moved, shown)
            moved = dataclasses.replace(moved, means=moved.means + added)
        where = jnp.where(healthy & jnp.all(finite), here, n)
        return Updated(
            put_rows(state.gaussians, where, moved),
            AdamState(
                state.moments.counts.at[where].set(new.counts, mode="drop", unique_indices=True),
                put_rows(state.moments.mu, where, new.mu),
                put_rows(state.moments.nu, where, new.nu),
            ),
            state.finite & finite,
        )

    start = Updated(gaussians, moments, jnp.ones(len(jax.tree.leaves(gaussians)), bool))
    used = jnp.minimum(count, ids.shape[0])
    return lax.fori_loop(0, -(-used // size), body, start)
