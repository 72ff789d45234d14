"""The scale gauges, fixed exactly: exposures recentred, radiance moved the other way.

With white balance every channel has a scale of its own.
"""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from p2gs_jax.render.harmonics import RadianceKind, scaled
from p2gs_jax.types import Params


def recentre(params: Params, activation: RadianceKind) -> Params:
    """Return the same photographs with mean log exposure and white balance 0.

    docs/photometry.md, 2, scale.

    Args:
        params: the fit.
        activation: from spherical harmonics to radiance. `exp` moves by a constant and `linear` by
            a factor, exactly.
    """
    # On the host: once a fit, and every operation would be a program of its own.
    photometry = jax.tree.map(np.asarray, params.photometry)
    log_scale = np.mean(photometry.log_exposures)
    balance = photometry.white_balance
    tint = np.zeros(3, np.float32) if balance is None else balance.mean(0)
    sh = scaled(np.asarray(params.gaussians.sh), log_scale + tint, activation)
    if photometry.parameterization == "log":
        raw = photometry.raw_exposures - log_scale
    else:
        raw = photometry.raw_exposures / np.exp(log_scale)
    moved = dataclasses.replace(
        photometry,
        raw_exposures=raw,
        raw_white_balance=None if balance is None else balance - tint,
    )
    return dataclasses.replace(
        params,
        gaussians=dataclasses.replace(params.gaussians, sh=jax.device_put(sh)),
        photometry=jax.device_put(moved),
    )
