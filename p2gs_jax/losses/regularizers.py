"""What fixes the gauges of exposures and gammas. Every term can be left out."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.config import RegularizerConfig
from p2gs_jax.types import GAMMA_SRGB, Photometry


def variance(x: Float[Array, " v"]) -> Float[Array, ""]:
    """Return the population variance in two passes: exact at large means, smooth at zero."""
    return jnp.mean((x - jnp.mean(x)) ** 2)


def photometry_regularizers(
    photometry: Photometry, cfg: RegularizerConfig
) -> dict[str, Float[Array, ""]]:
    """Return the weighted terms on exposures and gammas.

    The paper's three (eq. 10) resolve: global scale; spread (which also shrinks true spread, see
    docs/photometry.md, 3); tone. Ours resolve: the scale gauge alone; the power gauge.
    """
    e, gamma = photometry.exposures, photometry.gammas
    terms = {}
    if cfg.exposure_scale is not None:
        terms["exposure_scale"] = cfg.exposure_scale * jnp.mean((e - 1) ** 2)
    if cfg.exposure_variance is not None:
        terms["exposure_variance"] = cfg.exposure_variance * variance(e)
    if cfg.gamma_prior is not None:
        terms["gamma_prior"] = cfg.gamma_prior * jnp.mean((gamma - GAMMA_SRGB) ** 2)
    if cfg.log_exposure_mean is not None:
        mean = jnp.mean(photometry.log_exposures)
        terms["log_exposure_mean"] = cfg.log_exposure_mean * mean**2
    if cfg.gamma_mean_variance is not None:
        terms["gamma_mean_variance"] = cfg.gamma_mean_variance * (
            (jnp.mean(gamma) - GAMMA_SRGB) ** 2 + variance(gamma)
        )
    return terms
