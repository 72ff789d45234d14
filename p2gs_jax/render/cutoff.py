"""The opacity below which a contribution is skipped, under the rule `radiance`."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.types import Splats2D

SMALLEST_CUTOFF = 1e-7


def smallest_cutoff(cfg: RenderConfig) -> float:
    """Return the lowest cutoff that any splat may have."""
    if cfg.cutoff_rule == "opacity":
        return cfg.alpha_cutoff
    return min(SMALLEST_CUTOFF, cfg.alpha_cutoff)


def log_cutoffs(
    splats: Splats2D, radiance: Float[Array, "n 3"], cfg: RenderConfig
) -> Float[Array, " n"]:
    """Return each splat's log cutoff under the `radiance` rule.

    With L the brightest channel of a splat and M the geometric mean of L over the visible splats,
    the cutoff is alpha_cutoff min(1, M / L), at least 1e-7 and at most alpha_cutoff. A skipped
    contribution is then at most alpha_cutoff M (or 1e-7 L).
    """
    log_l = jnp.log(jnp.maximum(lax.stop_gradient(jnp.max(radiance, -1)), 1e-30))
    shown = splats.visible
    mean = jnp.sum(jnp.where(shown, log_l, 0)) / jnp.maximum(jnp.sum(shown), 1)
    lowered = float(np.log(cfg.alpha_cutoff)) - jnp.maximum(log_l - mean, 0)
    return jnp.maximum(lowered, float(np.log(smallest_cutoff(cfg))))


def with_cutoffs(splats: Splats2D, radiance: Float[Array, "n 3"], cfg: RenderConfig) -> Splats2D:
    """Return splats with the cutoffs that `cfg.cutoff_rule` gives them."""
    if cfg.cutoff_rule == "opacity":
        return splats
    return dataclasses.replace(splats, log_cutoffs=log_cutoffs(splats, radiance, cfg))
