"""Corrections of the poses of moving objects: their gradient, their prior and their step."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from p2gs_jax.config import RegularizerConfig
from p2gs_jax.losses.regularizers import pose_terms
from p2gs_jax.render.objects import with_corrections
from p2gs_jax.train.optimizer import AdamState
from p2gs_jax.types import Frustum, Placement

Placed = tuple[Float[Array, "k 4 4"], ...]
Poses = Float[Array, "t k 6"]


class MovedPoses(NamedTuple):
    """Corrections and their optimiser after a step; all None where there are none.

    Attributes:
        poses: corrections.
        moments: of the optimiser.
        terms: the prior, by name.
        finite: whether the gradient is, [1].
    """

    poses: Poses | None
    moments: Any
    terms: dict[str, Float[Array, ""]]
    finite: Bool[Array, " 1"] | None


def placed_by(frusta: Sequence[Frustum], poses: Poses | None) -> Placed | None:
    """Return the view matrices of all objects in each view; None where no poses are learned."""
    if poses is None:
        return None
    found = (f.objects for f in with_corrections(frusta, poses))
    return tuple(objects.viewmats for objects in found if objects is not None)


def seen_by(frusta: tuple[Frustum, ...], placed: Placed | None) -> tuple[Frustum, ...]:
    """Return the views with these view matrices; None leaves them as they are."""
    if placed is None:
        return frusta
    return tuple(
        dataclasses.replace(f, objects=dataclasses.replace(cast(Placement, f.objects), viewmats=v))
        for f, v in zip(frusta, placed, strict=True)
    )


def move_poses(
    poses: Poses | None,
    moments: tuple[AdamState, optax.EmptyState] | None,
    v_placed: Placed | None,
    frusta: tuple[Frustum, ...],
    optimizer: optax.GradientTransformationExtraArgs,
    rates: Float[Array, " 6"] | None,
    cfg: RegularizerConfig,
) -> MovedPoses:
    """Move the corrections by one step.

    What the view says nothing of rests, and so do its moments.

    Args:
        poses: corrections, or None.
        moments: of the optimiser, by row.
        v_placed: gradient of the loss by `placed_by`.
        frusta: the views; the prior is on what the first of them shows.
        optimizer: from `make_optimizer`, by row.
        rates: learning rates.
        cfg: weight of the prior.
    """
    if poses is None:
        return MovedPoses(None, moments, {}, None)
    _, pull = jax.vjp(lambda p: placed_by(frusta, p), poses)
    (v_poses,) = pull(v_placed)

    def prior(p):
        terms = pose_terms(p, frusta[0].objects, cfg)
        return jax.tree.reduce(jnp.add, terms, jnp.float32(0)), terms

    v_prior, terms = jax.grad(prior, has_aux=True)(poses)
    flat = poses.reshape(-1, 6)
    grads = (v_poses + v_prior).reshape(-1, 6)
    # optax annotates trees as nests of containers.
    updates, after = optimizer.update(grads, cast(Any, moments), flat, rates=rates)
    seen = jnp.any(grads != 0, axis=1) & jnp.all(jnp.isfinite(grads), axis=1)
    moved, after = jax.tree.map(
        lambda new, old: jnp.where(seen.reshape(-1, *(1,) * (new.ndim - 1)), new, old),
        (optax.apply_updates(flat, updates), after),
        (flat, moments),
    )
    return MovedPoses(
        cast(Array, moved).reshape(poses.shape), after, terms, jnp.all(jnp.isfinite(grads))[None]
    )
