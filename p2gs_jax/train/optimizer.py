"""Adam with a learning rate per group over the single parameter pytree.

With `visible_only`, a step updates only Gaussians that its view may show; moments and parameters of
the others do not change. Updates are counted per Gaussian, and bias correction uses this count. All
other parameters share one count.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.gaussians.population import grow
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.types import Array, Gaussians, Params

# Initial share of a learning rate with a warm-up (PPISP: 0.01).
WARMUP_START = 0.01


class AdamState(NamedTuple):
    """Moments, and counts of updates: one count, or one per row of the parameters."""

    counts: Int[Array, "..."]
    mu: Any
    nu: Any


class OptState(NamedTuple):
    """The optimiser's state."""

    gaussians: AdamState  # with one count per Gaussian
    rest: AdamState  # for (photometry, appearance), with one count


class Adam(NamedTuple):
    """Adam (Kingma and Ba 2015), as a static argument of compiled functions.

    `b1` and `b2` are the decay rates of the first and second moment; `eps` is added to the root of
    the second moment. With `by_row`, updates are counted per row, along the first axis that all
    parameters share.
    """

    b1: float = 0.9
    b2: float = 0.999
    eps: float = 1e-15
    by_row: bool = False

    def init(self, params: Any) -> AdamState:
        """Return the state before the first update."""
        rows = jax.tree.leaves(params)[0].shape[:1] if self.by_row else ()
        zeros = (jax.tree.map(jnp.zeros_like, params) for _ in range(2))
        return AdamState(jnp.zeros(rows, jnp.int32), *zeros)

    def update(
        self, grads: Any, state: AdamState, params: Any, rates: Any
    ) -> tuple[Any, AdamState]:
        """Return parameters and state after an update; `rates` broadcast against the leaves."""
        b1, b2 = self.b1, self.b2
        counts = state.counts + 1
        mu = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, state.mu, grads)
        nu = jax.tree.map(lambda v, g: b2 * v + (1 - b2) * g * g, state.nu, grads)
        dtype = jax.tree.leaves(mu)[0].dtype
        first = 1 / (1 - b1 ** counts.astype(dtype))
        second = 1 / (1 - b2 ** counts.astype(dtype))

        def moved(p, m, v, rate):
            shape = counts.shape + (1,) * (m.ndim - counts.ndim) if self.by_row else ()
            scaled = first.reshape(shape) * m / (jnp.sqrt(second.reshape(shape) * v) + self.eps)
            return (p + -rate * scaled).astype(p.dtype)

        return jax.tree.map(moved, params, mu, nu, rates), AdamState(counts, mu, nu)


class Optimizer(NamedTuple):
    """Adam for the Gaussians, by row, and Adam for (photometry, appearance)."""

    gaussians: Adam
    rest: Adam

    def init(self, params: Params) -> OptState:
        """Return the state before the first step."""
        rest = (params.photometry, params.appearance)
        return OptState(self.gaussians.init(params.gaussians), self.rest.init(rest))


def make_optimizer(cfg: FitConfig) -> Optimizer:
    """Return the optimiser of a fit; exposures, gammas and corrections use Adam's default betas."""
    o = cfg.optimizer
    return Optimizer(Adam(o.b1, o.b2, o.eps, by_row=True), Adam(eps=o.eps))


def means_rate(progress: Array, factor: Array, extent: float, cfg: FitConfig) -> Float[Array, ""]:
    """Return the learning rate of the means, scene units per step (3DGS: exponential decay)."""
    o = cfg.optimizer
    if o.means == 0:  # the means are fixed
        return 0.0 * factor
    return factor * extent * o.means * (o.means_final / o.means) ** progress


def appearance_rate(progress: Array, cfg: FitConfig) -> Float[Array, ""]:
    """Return the learning rate of corrections: it rises during a warm-up, then decays."""
    o = cfg.optimizer
    if o.appearance_warmup == 0:
        return jnp.asarray(o.appearance * o.appearance_final**progress)
    along = progress / o.appearance_warmup
    rising = WARMUP_START + (1 - WARMUP_START) * along
    decaying = o.appearance_final ** (progress - o.appearance_warmup)
    return o.appearance * jnp.where(along < 1, rising, decaying)


def learning_rates(
    progress: Array, factor: Array, extent: float, like: Params, cfg: FitConfig, bands: int
) -> Params:
    """Return the learning rate of every parameter, with shapes that broadcast against `like`.

    `factor` is on the rates of Gaussians except colours (`schedule.rate_factor`). `extent` is the
    scene extent in scene units; `bands` is the number of spherical-harmonics coefficients in use.
    """
    o = cfg.optimizer
    final = o.final**progress
    decay = factor * final
    # Colours keep their full learning rates in long fits (BUILD_NOTES, "Length").
    sh = jnp.full((bands, 1), o.sh_rest).at[0].set(o.sh_dc) * final
    # Exposure, white balance and gamma stay if they are solved; otherwise their rates decay.
    solved = cfg.photometry.start == "tracks"
    gate = jnp.zeros(()) if solved else o.photometry_final**progress
    varies = MODELS[cfg.photometry.model]
    # The order is that of the fields.
    of_gaussians = [means_rate(progress, factor, extent, cfg), o.quats * decay, o.scales * decay]
    of_gaussians += [o.opacities * decay, sh]
    if like.gaussians.vibration is not None:
        of_gaussians += [o.velocities * decay, o.peaks * decay, o.lives * decay]
    of_photometry = [o.exposures * gate * (varies.exposure == "view")]
    of_photometry += [o.gammas * gate * (varies.gamma == "view")]
    if like.photometry.raw_white_balance is not None:
        of_photometry += [o.exposures * gate * (cfg.photometry.white_balance == "view")]
    return Params(
        jax.tree.unflatten(jax.tree.structure(like.gaussians), of_gaussians),
        jax.tree.unflatten(jax.tree.structure(like.photometry), of_photometry),
        jax.tree.map(lambda _: appearance_rate(progress, cfg), like.appearance),
    )


def grow_moments(opt_state: OptState, empty: Gaussians) -> OptState:
    """Append zero moments for the slots of `empty`."""
    zeros = jax.tree.map(jnp.zeros_like, empty)
    new = AdamState(jnp.zeros(empty.capacity, opt_state.gaussians.counts.dtype), zeros, zeros)
    return opt_state._replace(gaussians=grow(opt_state.gaussians, new))


def zero_moments(opt_state: OptState, where: Bool[Array, " n"]) -> OptState:
    """Set the moments and counts of the flagged slots to zero."""

    def zero(a: Array) -> Array:
        return jnp.where(where.reshape((-1,) + (1,) * (a.ndim - 1)), 0, a)

    return opt_state._replace(gaussians=jax.tree.map(zero, opt_state.gaussians))


def zero_opacity_moments(opt_state: OptState) -> OptState:
    """Set the opacity moments of all slots to zero (3DGS, at an opacity reset)."""

    def zero(m: Gaussians) -> Gaussians:
        return dataclasses.replace(m, opacity_logits=jnp.zeros_like(m.opacity_logits))

    adam = opt_state.gaussians
    return opt_state._replace(gaussians=adam._replace(mu=zero(adam.mu), nu=zero(adam.nu)))
