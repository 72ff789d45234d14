"""One optimisation step: loss, gradient, optax update, statistics; a pure jitted function."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.losses.regularizers import population_terms
from p2gs_jax.losses.total import LossAux, Partner, decoded, image_loss, partner_cameras
from p2gs_jax.render.blocks import splat, splat_listed, whole_blocks
from p2gs_jax.render.capacity import Room
from p2gs_jax.render.spherical_harmonics import coefficient_count
from p2gs_jax.render.visible import compact, in_view
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.optimizer import Optimizer, OptState, learning_rates, means_rate
from p2gs_jax.train.state import (
    FAULT_NONE,
    FAULT_NONFINITE,
    FAULT_OVERFLOW,
    Fault,
    FitState,
)
from p2gs_jax.train.update import update_listed
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Photometry, Population


class Controls(eqx.Module):
    """What the schedule says about this step.

    Attributes:
        progress: fraction of the run completed.
        active_degree: spherical-harmonics degree in use.
    """

    progress: Float[Array, ""]
    active_degree: Int[Array, ""]


class StepReport(NamedTuple):
    """What a step tells the host, read when the host gets round to it."""

    loss: Float[Array, ""]
    terms: dict[str, Float[Array, ""]]
    psnr: Float[Array, ""]
    entries: Int[Array, ""]
    visible: Int[Array, ""]


Step = Callable[..., tuple[FitState, StepReport]]
GRADIENT_NAMES = (
    *(f"gradient of {f.name}" for f in dataclasses.fields(Gaussians)),
    "gradient of exposures",
    "gradient of gammas",
    "gradient of appearance",
)


def finite_names(terms: dict) -> tuple[str, ...]:
    """Return the names, in the order of `Fault.term`."""
    return (*(f"loss term {k}" for k in terms), *GRADIENT_NAMES)


def _recentered(photometry: Photometry, cfg: FitConfig) -> Photometry:
    """Project the scale gauge: mean log e = 0 exactly (docs/photometry.md, 4)."""
    if photometry.parameterization != "log":
        return photometry
    if cfg.loss.regularizers.log_exposure_mean is None:
        return photometry
    raw = photometry.raw_exposures
    return dataclasses.replace(photometry, raw_exposures=raw - jnp.mean(raw))


def _rest_updated(optimizer: Optimizer, moments, rest, grads, rates, cfg: FitConfig):
    """Return photometry and appearance after a step, and their moments."""
    # optax annotates trees as nests of containers and does not know our records.
    updates, moments = optimizer.rest.update(grads, moments, rest, rates=rates)
    photometry, appearance = cast(Any, optax.apply_updates(rest, updates))
    return (_recentered(photometry, cfg), appearance), moments


def _observed(population: Population, ids, v_means2d: Array, aux: LossAux, camera: Camera):
    """Add this view to the densification statistics of what it shows.

    Gradients are in units of half the image, as 3DGS has them.
    """
    gradient = v_means2d * jnp.array([camera.width / 2, camera.height / 2])
    seen = aux.render.visible & (jnp.sum(jnp.abs(gradient), -1) > 0)

    def added(a, b):
        return a.at[ids].add(b, mode="drop", unique_indices=True)

    return dataclasses.replace(
        population,
        grad2d_sum=added(population.grad2d_sum, jnp.linalg.norm(gradient, axis=-1)),
        seen_count=added(population.seen_count, seen.astype(jnp.float32)),
    )


def make_step(cfg: FitConfig, optimizer: Optimizer, extent: float):
    """Return the jitted step `(state, batch, partner, controls, room=..., degree=...)`.

    It gives the next state and a report. A step that finds no room or whose loss is not finite
    changes nothing but `state.fault`, and so do all steps after it, until the host has dealt with
    it; where only the gradient of some Gaussians is not finite, these keep their place. Randomness
    follows from the seed and the step number alone.

    The loss is that of `total_loss`. What is done per Gaussian is done in blocks, for those that
    the view may show; the others rest (`OptimizerConfig.visible_only`).

    Args:
        cfg: everything.
        optimizer: from `make_optimizer`.
        extent: scene extent, scene units.
    """
    mcmc = cfg.densify.method == "mcmc"

    @functools.partial(
        jax.jit,
        static_argnames=("room", "degree"),
        donate_argnums=0,
        compiler_options=compiler_options(),
    )
    def step(
        state: FitState,
        batch: Batch,
        partner: Partner,
        controls: Controls,
        *,
        room: Room,
        degree: int,
    ) -> tuple[FitState, StepReport]:
        gaussians, population = state.params.gaussians, state.population
        alive = population.alive
        n, bands = gaussians.capacity, coefficient_count(degree)
        cameras = (batch.camera, *partner_cameras(partner, cfg))
        if cfg.optimizer.visible_only:
            may = functools.reduce(
                jnp.logical_or, (in_view(gaussians, alive, c, cfg.render) for c in cameras)
            )
            ids, count = compact(may, whole_blocks(min(room.visible, n)))
        else:
            index = jnp.arange(whole_blocks(n), dtype=jnp.int32)
            ids, count = jnp.minimum(index, n), jnp.int32(n)
        shown = splat_listed(
            gaussians, alive, ids, count, cameras, cfg.render, controls.active_degree, bands
        )
        photometry, appearance = state.params.photometry, state.params.appearance
        (loss, aux), (v_shown, *v_rest) = jax.value_and_grad(
            image_loss, argnums=(0, 1, 2), has_aux=True, allow_int=True
        )(shown, photometry, appearance, batch, partner, cfg, room.entries)

        fits = ~aux.overflow & (count <= ids.shape[0])
        first = state.fault.kind == FAULT_NONE
        healthy = first & fits & jnp.all(_finite((aux.terms, v_rest)))

        rates = learning_rates(controls.progress, extent, state.params, cfg, bands)
        listed = jnp.sum(alive.at[ids].get(mode="fill", fill_value=False))
        updated = update_listed(
            gaussians,
            state.opt_state.gaussians[0],
            alive,
            ids,
            count,
            healthy,
            bands=bands,
            seen=lambda block, on: _differentiable(
                splat(block, on, cameras, cfg.render, controls.active_degree)
            ),
            v_seen=_differentiable(v_shown),
            own=lambda block, on: population_terms(block, on, cfg, extent, listed),
            optimizer=optimizer.gaussians,
            rates=rates.gaussians,
            key=jax.random.fold_in(jax.random.key(cfg.train.seed), state.step),
            noise_rate=cfg.densify.noise * means_rate(controls.progress, extent, cfg)
            if mcmc
            else None,
        )
        rest, rest_moments = _rest_updated(
            optimizer,
            state.opt_state.rest,
            (photometry, appearance),
            tuple(v_rest),
            (rates.photometry, rates.appearance),
            cfg,
        )
        if not mcmc:
            where = jnp.where(healthy, ids, n)
            v_means2d = v_shown[0][0].means2d
            population = _observed(population, where, v_means2d, aux, batch.camera)

        # In the order of `finite_names`.
        terms = aux.terms | updated.value
        checked = jnp.concatenate([_finite(terms), updated.finite, _finite(v_rest)])
        broken = FAULT_NONFINITE * ~jnp.all(checked)
        kind = jnp.where(fits, broken, FAULT_OVERFLOW).astype(jnp.int32)
        term = jnp.argmin(checked).astype(jnp.int32)
        fault = jax.tree.map(
            lambda a, b: jnp.where(first, a, b), Fault(kind, aux.entries, count, term), state.fault
        )
        rest, rest_moments = jax.tree.map(
            lambda new, old: jnp.where(healthy, new, old),
            (rest, rest_moments),
            ((photometry, appearance), state.opt_state.rest),
        )
        advanced = fault.kind == FAULT_NONE
        state = FitState(
            Params(updated.gaussians, *rest),
            OptState((updated.moments, optax.EmptyState()), rest_moments),
            population,
            state.step + advanced,
            fault,
        )
        photograph, mask = decoded(batch)
        squared = mask[..., None] * (jnp.clip(aux.ldr, 0, 1) - photograph) ** 2
        mse = jnp.sum(squared) / jnp.maximum(3 * jnp.sum(mask), 1)
        psnr = -10 * jnp.log10(jnp.maximum(mse, 1e-10))
        loss = jax.tree.reduce(jnp.add, updated.value, loss)
        return state, StepReport(loss, terms, psnr, aux.entries, count)

    return step


def _differentiable(shown):
    """Return what the image is made of, without flags and what only bins."""
    return tuple(
        (s.means2d, s.conic_factor, s.log_opacities, s.depths, radiance) for s, radiance in shown
    )


def _finite(values) -> Bool[Array, " k"]:
    """Return whether each array of a tree is finite."""
    return jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(values)])
