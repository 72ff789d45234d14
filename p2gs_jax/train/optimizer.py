"""Adam with a learning rate per group, as one optax chain over the single parameter pytree."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from p2gs_jax.config import FitConfig
from p2gs_jax.photometry.solution import LADDER
from p2gs_jax.types import Gaussians, Params, Photometry


def scale_by_rates() -> optax.GradientTransformationExtraArgs:
    """Multiply each update by minus its own learning rate, given at update time as `rates`."""

    def update(updates, state, params=None, **extra: Any):
        del params
        rates: Params = extra["rates"]
        return jax.tree.map(lambda u, r: -r * u, updates, rates), state

    return optax.GradientTransformationExtraArgs(lambda params: optax.EmptyState(), update)


def make_optimizer(cfg: FitConfig) -> optax.GradientTransformationExtraArgs:
    """Return Adam followed by the group rates."""
    return optax.chain(optax.scale_by_adam(eps=cfg.optimizer.eps), scale_by_rates())


def means_rate(progress: Array, extent: float, cfg: FitConfig) -> Float[Array, ""]:
    """Return the learning rate of the means, scene units per step (3DGS: exponential decay)."""
    o = cfg.optimizer
    return extent * o.means * (o.means_final / o.means) ** progress


def photometry_gate(progress: Array, cfg: FitConfig) -> Float[Array, ""]:
    """Return the factor on exposure and gamma rates: 0 while frozen, then decaying.

    Only a start from tracks is worth freezing; a random one must move from the first step.
    """
    frozen = cfg.photometry.freeze_until if cfg.photometry.start == "tracks" else 0.0
    if frozen >= 1.0:
        return jnp.zeros(())
    along = (progress - frozen) / (1.0 - frozen)
    rate = cfg.optimizer.photometry_final ** jnp.clip(along, 0.0, 1.0)
    return jnp.where(along >= 0, rate, 0.0)


def learning_rates(progress: Array, extent: float, like: Params, cfg: FitConfig) -> Params:
    """Return the rate of every parameter, shaped to broadcast against `like`.

    Args:
        progress: fraction of the run completed.
        extent: scene extent, scene units.
        like: the parameters, for their structure.
        cfg: rates and schedules.
    """
    o = cfg.optimizer
    decay = o.final**progress
    bands = like.gaussians.sh.shape[1]
    sh = jnp.full((bands, 1), o.sh_rest).at[0].set(o.sh_dc) * decay
    gate = photometry_gate(progress, cfg)
    varies = LADDER[cfg.photometry.model]
    return Params(
        gaussians=Gaussians(
            means=means_rate(progress, extent, cfg),
            quats=o.quats * decay,
            log_scales=o.scales * decay,
            opacity_logits=o.opacities * decay,
            sh=sh,
        ),
        photometry=Photometry(
            o.exposures * gate * (varies.exposure == "view"),
            o.gammas * gate * (varies.gamma == "view"),
            like.photometry.parameterization,
        ),
        appearance=None
        if like.appearance is None
        else jnp.asarray(o.appearance * o.appearance_final**progress),
    )


def map_moments(opt_state, change):
    """Apply `change` (Gaussians -> Gaussians) to both Adam moments of the Gaussians."""
    adam = opt_state[0]

    def moved(moment: Params) -> Params:
        return dataclasses.replace(moment, gaussians=change(moment.gaussians))

    return (adam._replace(mu=moved(adam.mu), nu=moved(adam.nu)), *opt_state[1:])


def zero_moments(opt_state, where: Bool[Array, " n"]):
    """Forget the moments of the given slots."""

    def zero(moment: Gaussians) -> Gaussians:
        return jax.tree.map(
            lambda a: jnp.where(where.reshape((-1,) + (1,) * (a.ndim - 1)), 0.0, a), moment
        )

    return map_moments(opt_state, zero)


def zero_opacity_moments(opt_state):
    """Forget the opacity moments of all slots (3DGS, at an opacity reset)."""
    return map_moments(
        opt_state,
        lambda m: dataclasses.replace(m, opacity_logits=jnp.zeros_like(m.opacity_logits)),
    )
