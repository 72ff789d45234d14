"""The parameter update of a step: Adam moves the listed Gaussians, or a fault keeps all parameters.

Gaussians are moved block by block. Each block is read, differentiated, updated and written once,
while the cache holds it; no temporary array is as large as the population.

A step that overflows, or whose loss is not finite, changes nothing but `state.fault`. Later steps
change nothing until the host clears the fault. If only the gradients of some Gaussians are not
finite, the whole block that holds them stays unchanged, and the fault ends the run.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, UInt32

from p2gs_jax.config import FitConfig
from p2gs_jax.core.streams import noise_key
from p2gs_jax.gaussians.mcmc import exploration_noise
from p2gs_jax.render.cores import all_true, cores, most, this_core
from p2gs_jax.render.harmonics import coefficient_count
from p2gs_jax.render.visible import (
    block_size,
    over_blocks,
    owners_at,
    put_rows,
    slice_of,
    splat,
    take_rows,
)
from p2gs_jax.train import optimizer as optimizers
from p2gs_jax.train.image_gradient import ImageGradient, differentiable
from p2gs_jax.train.state import FAULT_NONE, FAULT_NONFINITE, FAULT_OVERFLOW, Fault, FitState
from p2gs_jax.types import Array, Frustum, Gaussians, Params, Photometry, Population, Vibration


class Controls(eqx.Module):
    """The host's settings of one step."""

    progress: Float[Array, ""]  # fraction of the run completed
    active_degree: Int[Array, ""]  # spherical-harmonics degree in use
    # factor on the learning rates of Gaussians except colours, from the length of the fit
    rate: Float[Array, ""]
    seed: UInt32[Array, ""]  # seed of the fit, from `device_seed`


class StepReport(NamedTuple):
    """The report of a step to the host."""

    loss: Float[Array, ""]  # sum of the terms
    terms: dict[str, Float[Array, ""]]  # weighted loss terms by name
    psnr: Float[Array, ""]  # of the view, dB
    entries: Int[Array, ""]  # tile-list entries needed
    visible: Int[Array, ""]  # Gaussians that the view may show


class Updated(NamedTuple):
    """Gaussians and their moments after a step.

    `finite` flags, in the order of the fields of `Gaussians`, the arrays with a finite gradient.
    """

    gaussians: Gaussians
    moments: optimizers.AdamState
    finite: Bool[Array, " f"]


OF_GAUSSIANS = tuple(f.name for f in dataclasses.fields(Gaussians) if f.name != "vibration")
OF_VIBRATION = tuple(f.name for f in dataclasses.fields(Vibration))


def finite_names(terms: dict, params: Params) -> tuple[str, ...]:
    """Return the names of loss terms and gradients, in the order of `Fault.term`."""
    optional = {
        "gradient of white balances": params.photometry.raw_white_balance,
        "gradient of appearance": params.appearance,
    }
    rest = (name for name, value in optional.items() if value is not None)
    vibration = () if params.gaussians.vibration is None else OF_VIBRATION
    always = (*OF_GAUSSIANS, *vibration, "exposures", "gammas")
    gradients = (f"gradient of {name}" for name in always)
    return (*(f"loss term {k}" for k in terms), *gradients, *rest)


def advance(
    state: FitState,
    ids: Int[Array, " v"],
    count: Int[Array, ""],
    gradient: ImageGradient,
    frustum: Frustum,
    controls: Controls,
    *,
    cfg: FitConfig,
    optimizer: optimizers.Optimizer,
    extent: float,
    noise: float | None,
    degree: int,
) -> tuple[FitState, StepReport]:
    """Move the listed Gaussians, photometry and corrections by one step; the state is donated.

    `ids` lists the Gaussians and `count` is the number that the view may show, both from `show`.
    `extent` is the scene extent in scene units; `degree` is the highest spherical-harmonics degree
    that moves. `noise` is the scale of the exploration noise on the means. If it is None, the step
    adds statistics for densification instead.
    """
    gaussians, population = state.params.gaussians, state.population
    n, bands = gaussians.capacity, coefficient_count(degree)
    fits = ~gradient.overflow & (count <= ids.shape[0])
    healthy = is_healthy(state, gradient, fits)
    progress, rate = controls.progress, controls.rate
    rates = optimizers.learning_rates(progress, rate, extent, state.params, cfg, bands)
    key = noise_key(controls.seed, state.step)
    if cores() > 1:
        key = jax.random.fold_in(key, this_core())
    noise_rate = (noise or 0.0) * optimizers.means_rate(progress, rate, extent, cfg)

    def exploring(block, _, moved, on):
        # Always float32, so that the random numbers are equal in any precision.
        block_key = jax.random.fold_in(key, block)
        normal = jax.random.normal(block_key, moved.means.shape, jnp.float32)
        return exploration_noise(normal, moved, on, noise_rate)

    updated = update_listed(
        state,
        ids,
        count,
        healthy,
        bands=bands,
        inputs_of=lambda block, on, owner: differentiable(
            splat(block, on, frustum, cfg.render, controls.active_degree, owner)
        ),
        v_inputs=gradient.v_shown,
        adam=optimizer.gaussians,
        rates=rates.gaussians,
        noise=None if noise is None else exploring,
    )
    updated = updated._replace(finite=all_true(updated.finite))
    if noise is None:
        where = jnp.where(healthy, ids, n)
        population = _observed(population, where, gradient, frustum)
    moved, checks = (updated, population), (fits, healthy, most(count))
    return finished(state, moved, gradient, checks, rates, cfg=cfg, optimizer=optimizer)


def update_listed(
    state: FitState,
    ids: Int[Array, " v"],
    count: Int[Array, ""],
    healthy: Bool[Array, ""],
    *,
    bands: int,
    inputs_of: Callable[[Gaussians, Bool[Array, " b"], Any], Any],
    v_inputs: Any,
    adam: optimizers.Adam,
    rates: Gaussians,
    noise: Callable[..., Float[Array, "b 3"]] | None,
) -> Updated:
    """Move the listed Gaussians by one step; nothing is written unless the step is `healthy`.

    Args:
        ids: from `compact`, in whole blocks; the first `count` are listed.
        bands: number of spherical-harmonics coefficients that are read and moved.
        inputs_of: (Gaussians, alive, owner) of a block -> the differentiable inputs of the image.
        v_inputs: gradient of the loss by these inputs, for the whole list.
        noise: (number of the block, ids, Gaussians, alive) -> noise on their means; or None.
    """
    gaussians, population = state.params.gaussians, state.population
    n, size = gaussians.capacity, block_size(ids.shape[0])

    def body(k, updated: Updated) -> Updated:
        here = slice_of(ids, k, size)
        live = population.alive.at[here].get(mode="fill", fill_value=False)
        owners = owners_at(population.owner, here)
        old = take_rows(updated.gaussians, here, bands)
        _, pull = jax.vjp(lambda block: inputs_of(block, live, owners), old)
        (grads,) = pull(slice_of(v_inputs, k, size))
        finite = jnp.stack([jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(grads)])
        before = optimizers.AdamState(
            updated.moments.counts.at[here].get(mode="clip"),
            take_rows(updated.moments.mu, here, bands),
            take_rows(updated.moments.nu, here, bands),
        )
        moved, new = adam.update(grads, before, old, rates)
        if noise is not None:
            moved = dataclasses.replace(moved, means=moved.means + noise(k, here, moved, live))
        where = jnp.where(healthy & jnp.all(finite), here, n)
        return Updated(
            put_rows(updated.gaussians, where, moved),
            optimizers.AdamState(
                updated.moments.counts.at[where].set(new.counts, mode="drop", unique_indices=True),
                put_rows(updated.moments.mu, where, new.mu),
                put_rows(updated.moments.nu, where, new.nu),
            ),
            updated.finite & finite,
        )

    finite = jnp.ones(len(jax.tree.leaves(gaussians)), bool)
    start = Updated(gaussians, state.opt_state.gaussians, finite)
    return over_blocks(body, count, ids.shape[0], start)


def is_healthy(state: FitState, gradient: ImageGradient, fits: Array) -> Bool[Array, ""]:
    """Return whether a step may write: no earlier fault, no overflow, and a finite loss."""
    unbroken = jnp.all(_finite((gradient.terms, gradient.v_rest)))
    return (state.fault.kind == FAULT_NONE) & fits & unbroken


def finished(
    state: FitState,
    moved: tuple[Updated, Population],
    gradient: ImageGradient,
    checks: tuple[Bool[Array, ""], Bool[Array, ""], Int[Array, ""]],
    rates: Params,
    *,
    cfg: FitConfig,
    optimizer: optimizers.Optimizer,
    views: int = 1,
) -> tuple[FitState, StepReport]:
    """Move photometry and corrections; return the state after the step, and its report.

    `moved` holds the Gaussians after the step and the population with its statistics. `checks`
    holds whether the lists were long enough, whether the step is healthy, and how many Gaussians a
    view may show. `views` is the number of views of the step.
    """
    (updated, population), (fits, healthy, count) = moved, checks
    free = state.fault.kind == FAULT_NONE
    old_rest = (state.params.photometry, state.params.appearance)
    (photometry, appearance), rest_moments = optimizer.rest.update(
        gradient.v_rest, state.opt_state.rest, old_rest, (rates.photometry, rates.appearance)
    )
    rest = (_recentered(photometry, cfg), appearance)

    # In the order of `finite_names`.
    v_photometry, v_appearance = gradient.v_rest
    checked = [_finite(gradient.terms), updated.finite, _finite(v_photometry)]
    if v_appearance is not None:
        checked.append(jnp.all(_finite(v_appearance))[None])
    checked = jnp.concatenate(checked)
    broken = FAULT_NONFINITE * ~jnp.all(checked)
    kind = jnp.where(fits, broken, FAULT_OVERFLOW).astype(jnp.int32)
    term = jnp.argmin(checked).astype(jnp.int32)
    fault = jax.tree.map(
        lambda a, b: jnp.where(free, a, b), Fault(kind, gradient.entries, count, term), state.fault
    )
    (photometry, appearance), rest_moments = jax.tree.map(
        lambda new, old: jnp.where(healthy, new, old),
        (rest, rest_moments),
        (old_rest, state.opt_state.rest),
    )
    state = FitState(
        Params(updated.gaussians, photometry, appearance),
        optimizers.OptState(updated.moments, rest_moments),
        population,
        state.step + views * (fault.kind == FAULT_NONE),
        fault,
    )
    report = StepReport(gradient.loss, gradient.terms, gradient.psnr, gradient.entries, count)
    return state, report


def _recentered(photometry: Photometry, cfg: FitConfig) -> Photometry:
    """Fix the scale gauges: mean log e = 0 and mean log W = 0 (docs/photometry.md, 2, 4).

    Solved photometry stays as it is.
    """
    if cfg.photometry.start == "tracks":
        return photometry
    balance = photometry.raw_white_balance
    if balance is not None:
        balance = balance - jnp.mean(balance, 0)
        photometry = dataclasses.replace(photometry, raw_white_balance=balance)
    if photometry.parameterization != "log":
        return photometry
    if cfg.loss.regularizers.log_exposure_mean is None:
        return photometry
    raw = photometry.raw_exposures
    return dataclasses.replace(photometry, raw_exposures=raw - jnp.mean(raw))


def _observed(population: Population, ids, image: ImageGradient, frustum: Frustum) -> Population:
    """Add this view to the densification statistics of the Gaussians that it shows.

    Gradients are in units of half the image, as in 3DGS.
    """
    v_means2d = image.v_shown[0]
    gradient = v_means2d * jnp.stack([frustum.width / 2, frustum.height / 2])
    seen = image.visible & (jnp.sum(jnp.abs(gradient), -1) > 0)

    def added(a, b):
        return a.at[ids].add(b, mode="drop", unique_indices=True)

    return dataclasses.replace(
        population,
        grad2d_sum=added(population.grad2d_sum, jnp.linalg.norm(gradient, axis=-1)),
        seen_count=added(population.seen_count, seen.astype(jnp.float32)),
    )


def _finite(values) -> Bool[Array, " k"]:
    """Return whether each array of a tree is finite; a formation may have no arrays."""
    found = [jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(values)]
    return jnp.stack(found) if found else jnp.ones(1, bool)
