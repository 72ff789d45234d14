"""Photometric parameters of a fit: their initial values, and the gauge of the result."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.appearance import Corrections, identity
from p2gs_jax.photometry.formation import camera_rows, inverse_tone_map
from p2gs_jax.photometry.luminance import Luminance, statistics_of
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.render.harmonics import RadianceKind, scaled
from p2gs_jax.types import GAMMA_SRGB, Params, Photometry, Scene, View

LEAST_EXPOSURE = 0.1  # lower bound of random exposures


def initial_photometry(
    solution: PhotometricSolution | None, cameras: Sequence[str], cfg: FitConfig
) -> Photometry:
    """Return the start: a solution, or gamma 2.2 with random exposures (paper) if these vary.

    `cameras` has the camera of every training view.
    """
    count = len(cameras)
    p = cfg.photometry
    if solution is not None:
        log_exposures = np.asarray(solution.log_exposures)
    else:
        std = p.start_std if MODELS[p.model].exposure else 0.0
        draws = generator(cfg.train.seed, Stream.START_EXPOSURES).normal(1.0, std, count)
        log_exposures = np.log(np.maximum(draws, LEAST_EXPOSURE))
    gammas = np.full(count, GAMMA_SRGB) if solution is None else solution.gammas
    if p.parameterization == "log":
        exposures, gammas = log_exposures, np.log(gammas / GAMMA_SRGB)
    else:
        exposures = np.exp(log_exposures)
    balance = None
    if p.white_balance is not None:
        balance = on_device(np.zeros((count, 3)) if solution is None else solution.white_balance)
    rows = camera_rows(cameras, p)
    return Photometry(on_device(exposures), on_device(gammas), p.parameterization, balance, rows)


def initial_appearance(
    views: Sequence[View],
    cfg: FitConfig,
    photograph: Callable[[int], tuple[np.ndarray, np.ndarray]] | None = None,
) -> Corrections | None:
    """Return corrections that change nothing; None: the fit has no corrections.

    `photograph(k)` returns the display values and the mask of `views[k]`. Luminance-GS needs it.
    """
    kind = cfg.photometry.appearance
    if kind is None:
        return None
    start = identity(kind, [view.camera for view in views])
    if isinstance(start, Luminance) and photograph is not None:
        rows = [statistics_of(*map(jnp.asarray, photograph(k))) for k in range(len(views))]
        return dataclasses.replace(start, statistics=on_device(np.stack(rows)))
    return start


def point_radiance(
    scene: Scene, solution: PhotometricSolution | None, cfg: FitConfig
) -> Float[np.ndarray, "p 3"]:
    """Return linear radiance of a scene's points, from the solution or else from their colours."""
    assert scene.point_colors is not None
    colors = scene.point_colors.astype(np.float32) / np.float32(255)
    radiance = inverse_tone_map(colors, np.float32(GAMMA_SRGB), cfg.photometry)
    if solution is not None:
        known = np.exp(solution.point_log_radiance)
        usual = radiance / np.exp(np.mean(solution.log_exposures))  # known ones have any unit
        radiance = np.where(np.isfinite(known), known, usual)
    return radiance.astype(np.float32)


def recentre(params: Params, activation: RadianceKind) -> Params:
    """Return parameters whose log exposures and log white balances have the mean 0 over the views.

    Radiance is scaled inversely, so that photographs do not change. This fixes the gauge of scale
    (docs/photometry.md, 2), with white balance one per channel. `activation` maps spherical
    harmonics to radiance.
    """
    # Computed on the host, because every operation on the device would compile a program.
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
        photometry, raw_exposures=raw, raw_white_balance=None if balance is None else balance - tint
    )
    return dataclasses.replace(
        params,
        gaussians=dataclasses.replace(params.gaussians, sh=jax.device_put(sh)),
        photometry=jax.device_put(moved),
    )
