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
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.densify.mcmc import exploration_noise
from p2gs_jax.losses.total import LossAux, Partner, total_loss
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.optimizer import learning_rates, means_rate
from p2gs_jax.train.state import (
    FAULT_NONE,
    FAULT_NONFINITE,
    FAULT_OVERFLOW,
    Fault,
    FitState,
)
from p2gs_jax.types import Batch, Gaussians, Params, Photometry, Population


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


def _first_nonfinite(aux: LossAux, grads: Params) -> tuple[Array, Array]:
    values = [*aux.terms.values(), *jax.tree.leaves(grads)]
    finite = jnp.stack([jnp.isfinite(jnp.sum(v)) for v in values])
    return ~jnp.all(finite), jnp.argmin(finite).astype(jnp.int32)


def _recentered(photometry: Photometry, cfg: FitConfig) -> Photometry:
    """Project the scale gauge: mean log e = 0 exactly (docs/photometry.md, 4)."""
    if photometry.parameterization != "log":
        return photometry
    if cfg.loss.regularizers.log_exposure_mean is None:
        return photometry
    raw = photometry.raw_exposures
    return dataclasses.replace(photometry, raw_exposures=raw - jnp.mean(raw))


def _observed(population: Population, v_probe: Array, aux: LossAux, state: FitState) -> Population:
    """Add this view to the densification statistics."""
    seen = aux.render.visible & (jnp.sum(jnp.abs(v_probe), -1) > 0)
    return dataclasses.replace(
        population,
        grad2d_sum=population.grad2d_sum + jnp.linalg.norm(v_probe, axis=-1),
        seen_count=population.seen_count + seen,
    )


def make_step(cfg: FitConfig, optimizer: optax.GradientTransformationExtraArgs, extent: float):
    """Return the jitted step `(state, batch, partner, controls, capacity=...) -> (state, report)`.

    A step that would overflow the tile list or is not finite changes nothing but `state.fault`,
    and so do all steps after it, until the host has dealt with it. Randomness follows from the
    seed and the step number alone.

    Args:
        cfg: everything.
        optimizer: from `make_optimizer`.
        extent: scene extent, scene units.
    """
    wants_probe = cfg.densify.method == "adaptive"

    @functools.partial(
        jax.jit,
        static_argnames="capacity",
        donate_argnums=0,
        compiler_options=compiler_options(),
    )
    def step(
        state: FitState, batch: Batch, partner: Partner, controls: Controls, *, capacity: int
    ) -> tuple[FitState, StepReport]:
        n = state.params.gaussians.capacity
        probe = jnp.zeros((n, 2)) if wants_probe else None
        loss_and_gradient = jax.value_and_grad(total_loss, argnums=(0, 1), has_aux=True)
        (loss, aux), (grads, v_probe) = loss_and_gradient(
            state.params,
            probe,
            state.population,
            batch,
            partner,
            cfg,
            capacity=capacity,
            active_degree=controls.active_degree,
            extent=extent,
        )
        broken, term = _first_nonfinite(aux, grads)
        kind = jnp.where(
            aux.overflow, FAULT_OVERFLOW, jnp.where(broken, FAULT_NONFINITE, FAULT_NONE)
        ).astype(jnp.int32)
        fault = Fault(kind, aux.entries, term)

        def advance(state: FitState) -> FitState:
            rates = learning_rates(controls.progress, extent, state.params, cfg)
            # optax annotates trees as nests of containers and does not know our records.
            updates, opt_state = optimizer.update(
                cast(Any, grads), state.opt_state, cast(Any, state.params), rates=rates
            )
            params = cast(Params, optax.apply_updates(cast(Any, state.params), updates))
            gaussians, population = params.gaussians, state.population
            if cfg.densify.method == "mcmc":
                key = jax.random.fold_in(jax.random.key(cfg.train.seed), state.step)
                rate = cfg.densify.noise * means_rate(controls.progress, extent, cfg)
                noise = exploration_noise(key, gaussians, population.alive, rate)
                gaussians = dataclasses.replace(gaussians, means=gaussians.means + noise)
            if wants_probe:
                population = _observed(population, v_probe, aux, state)
            params = Params(gaussians, _recentered(params.photometry, cfg), params.appearance)
            return FitState(params, opt_state, population, state.step + 1, state.fault)

        def stay(state: FitState) -> FitState:
            first = state.fault.kind == FAULT_NONE
            return dataclasses.replace(
                state, fault=jax.tree.map(lambda a, b: jnp.where(first, a, b), fault, state.fault)
            )

        healthy = (kind == FAULT_NONE) & (state.fault.kind == FAULT_NONE)
        state = lax.cond(healthy, advance, stay, state)
        mask = batch.mask[..., None]
        squared = mask * (jnp.clip(aux.ldr, 0, 1) - batch.ldr) ** 2
        mse = jnp.sum(squared) / jnp.maximum(3 * jnp.sum(batch.mask), 1)
        psnr = -10 * jnp.log10(jnp.maximum(mse, 1e-10))
        return state, StepReport(loss, aux.terms, psnr, aux.entries)

    return step
