"""The parameters' side of a step: the optimiser moves what was seen, or a fault keeps everything.

A step that finds no room or whose loss is not finite changes nothing but `state.fault`, and so do
all steps after it, until the host has dealt with it; where only the gradient of some Gaussians is
not finite, these keep their place.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, UInt32

from p2gs_jax.config import FitConfig
from p2gs_jax.core.streams import noise_key
from p2gs_jax.gaussians.mcmc import exploration_noise
from p2gs_jax.render.harmonics import coefficient_count
from p2gs_jax.render.visible import splat
from p2gs_jax.train.image_gradient import ImageGradient, differentiable
from p2gs_jax.train.optimizer import Optimizer, OptState, learning_rates, means_rate
from p2gs_jax.train.state import FAULT_NONE, FAULT_NONFINITE, FAULT_OVERFLOW, Fault, FitState
from p2gs_jax.train.update import Updated, update_listed
from p2gs_jax.types import Frustum, Gaussians, Params, Photometry, Population, Vibration


class Controls(eqx.Module):
    """What the host says about this step.

    Attributes:
        progress: fraction of the run completed.
        active_degree: spherical-harmonics degree in use.
        rate: factor on the rates of Gaussians but for colours, from the length of the fit.
        seed: of the fit, from `device_seed`.
    """

    progress: Float[Array, ""]
    active_degree: Int[Array, ""]
    rate: Float[Array, ""]
    seed: UInt32[Array, ""]


class StepReport(NamedTuple):
    """What a step tells the host, which reads it after a burst.

    Attributes:
        loss: sum of the terms.
        terms: by name, weighted.
        psnr: of the view, dB.
        entries: tile-list entries that the view needed.
        visible: Gaussians that it showed.
    """

    loss: Float[Array, ""]
    terms: dict[str, Float[Array, ""]]
    psnr: Float[Array, ""]
    entries: Int[Array, ""]
    visible: Int[Array, ""]


OF_GAUSSIANS = tuple(f.name for f in dataclasses.fields(Gaussians) if f.name != "vibration")
OF_VIBRATION = tuple(f.name for f in dataclasses.fields(Vibration))


def finite_names(terms: dict, params: Params) -> tuple[str, ...]:
    """Return the names, in the order of `Fault.term`.

    Args:
        terms: of the loss.
        params: of the fit, for what they consist of.
    """
    given = {
        "gradient of white balances": params.photometry.raw_white_balance,
        "gradient of appearance": params.appearance,
    }
    rest = (name for name, value in given.items() if value is not None)
    vibration = () if params.gaussians.vibration is None else OF_VIBRATION
    always = (*OF_GAUSSIANS, *vibration, "exposures", "gammas")
    of = (f"gradient of {name}" for name in always)
    return (*(f"loss term {k}" for k in terms), *of, *rest)


def advance(
    state: FitState,
    ids: Int[Array, " v"],
    count: Int[Array, ""],
    gradient: ImageGradient,
    frusta: tuple[Frustum, ...],
    controls: Controls,
    *,
    cfg: FitConfig,
    optimizer: Optimizer,
    extent: float,
    degree: int,
) -> tuple[FitState, StepReport]:
    """Move the listed Gaussians, photometry and corrections by one step.

    Args:
        state: before the step; donated.
        ids: of the listed Gaussians, from `show`.
        count: how many the views may show.
        gradient: of the images' loss.
        frusta: the views.
        controls: of the schedule.
        cfg: rendering, the terms on the Gaussians, rates, noise.
        optimizer: from `make_optimizer`.
        extent: scene extent, scene units.
        degree: highest spherical-harmonics degree that moves.
    """
    mcmc = cfg.densify.method == "mcmc"
    gaussians, population = state.params.gaussians, state.population
    alive = population.alive
    n, bands = gaussians.capacity, coefficient_count(degree)
    fits = ~gradient.overflow & (count <= ids.shape[0])
    healthy = is_healthy(state, gradient, fits)

    progress, rate = controls.progress, controls.rate
    rates = learning_rates(progress, rate, extent, state.params, cfg, bands)
    key = noise_key(controls.seed, state.step)
    noise_rate = cfg.densify.noise * means_rate(progress, rate, extent, cfg)

    def noise(block, _, moved, on):
        return exploration_noise(jax.random.fold_in(key, block), moved, on, noise_rate)

    updated = update_listed(
        gaussians,
        state.opt_state.gaussians[0],
        alive,
        ids,
        count,
        healthy,
        bands=bands,
        seen=lambda block, on, owner: differentiable(
            splat(block, on, frusta, cfg.render, controls.active_degree, owner)
        ),
        v_seen=gradient.v_shown,
        optimizer=optimizer.gaussians,
        rates=rates.gaussians,
        noise=noise if mcmc else None,
        owner=population.owner,
    )
    if not mcmc:
        where = jnp.where(healthy, ids, n)
        population = _observed(population, where, gradient, frusta[0])
    moved = Moved(updated, population)
    return settled(state, moved, gradient, fits, count, rates, cfg=cfg, optimizer=optimizer)


class Moved(NamedTuple):
    """What a step did to everything that there is one of for each Gaussian.

    Attributes:
        updated: Gaussians.
        population: with this step's statistics.
    """

    updated: Updated
    population: Population


def is_healthy(state: FitState, gradient: ImageGradient, fits: Array) -> Bool[Array, ""]:
    """Return whether a step may write: no fault before it, room, and a finite loss."""
    first = state.fault.kind == FAULT_NONE
    return first & fits & jnp.all(_finite((gradient.terms, gradient.v_rest)))


def settled(
    state: FitState,
    moved: Moved,
    gradient: ImageGradient,
    fits: Bool[Array, ""],
    count: Int[Array, ""],
    rates: Params,
    *,
    cfg: FitConfig,
    optimizer: Optimizer,
    views: int = 1,
) -> tuple[FitState, StepReport]:
    """Move the rest, and return the state after a step with what became of it.

    Args:
        state: before the step.
        moved: what is done already.
        gradient: of the images' loss.
        fits: everything found room.
        count: Gaussians that a view may show.
        rates: learning rates.
        cfg: the gauge of the exposures.
        optimizer: from `make_optimizer`.
        views: that the step took.
    """
    updated, population = moved
    first = state.fault.kind == FAULT_NONE
    healthy = is_healthy(state, gradient, fits)
    old_rest = (state.params.photometry, state.params.appearance)
    rest, rest_moments = _rest_updated(
        optimizer,
        state.opt_state.rest,
        old_rest,
        gradient.v_rest,
        (rates.photometry, rates.appearance),
        cfg,
    )

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
        lambda a, b: jnp.where(first, a, b),
        Fault(kind, gradient.entries, count, term),
        state.fault,
    )
    (photometry, appearance), rest_moments = jax.tree.map(
        lambda new, old: jnp.where(healthy, new, old),
        (rest, rest_moments),
        (old_rest, state.opt_state.rest),
    )
    state = FitState(
        Params(updated.gaussians, photometry, appearance),
        OptState((updated.moments, optax.EmptyState()), rest_moments),
        population,
        state.step + views * (fault.kind == FAULT_NONE),
        fault,
    )
    report = StepReport(gradient.loss, gradient.terms, gradient.psnr, gradient.entries, count)
    return state, report


def _rest_updated(optimizer: Optimizer, moments, rest, grads, rates, cfg: FitConfig):
    """Return photometry and appearance after a step, and their moments."""
    # optax annotates trees as nests of containers and does not know our records.
    updates, moments = optimizer.rest.update(grads, moments, rest, rates=rates)
    photometry, appearance = cast(Any, optax.apply_updates(rest, updates))
    return (_recentered(photometry, cfg), appearance), moments


def _recentered(photometry: Photometry, cfg: FitConfig) -> Photometry:
    """Project the scale gauges: mean log e = 0 and mean log W = 0 (docs/photometry.md, 2, 4)."""
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
    """Add this view to the densification statistics of what it shows.

    Gradients are in units of half the image, as 3DGS has them.
    """
    v_means2d = image.v_shown[0][0]
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
    """Return whether each array of a tree is finite."""
    return jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(values)])
