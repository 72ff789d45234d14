"""The scale gauge, fixed exactly: exposures recentred, radiance moved the other way."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from p2gs_jax.photometry.radiance import RadianceKind
from p2gs_jax.render.spherical_harmonics import C0
from p2gs_jax.types import Params


def recentre(params: Params, activation: RadianceKind) -> Params:
    """Return the same photographs with mean log exposure 0 (docs/photometry.md, 2, scale).

    Args:
        params: the fit.
        activation: from spherical harmonics to radiance. `exp` moves by a constant and `linear` by
            a factor, exactly; `softplus` can do neither, and is returned as it is.
    """
    if activation == "softplus":
        return params
    photometry, sh = params.photometry, params.gaussians.sh
    log_scale = jnp.mean(jnp.log(photometry.exposures))
    factor = jnp.exp(log_scale)
    if activation == "exp":
        sh = sh.at[:, 0].add(log_scale / C0)
    else:
        # radiance = value + 1/2: the half must grow with the rest.
        sh = (sh * factor).at[:, 0].add((factor - 1) * 0.5 / C0)
    if photometry.parameterization == "log":
        raw = photometry.raw_exposures - log_scale
    else:
        raw = photometry.raw_exposures / factor
    return dataclasses.replace(
        params,
        gaussians=dataclasses.replace(params.gaussians, sh=sh),
        photometry=dataclasses.replace(photometry, raw_exposures=raw),
    )
