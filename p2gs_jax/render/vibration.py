"""Gaussians that come, move and go, as a function of time (PVG, arXiv 2311.18561, section 3.2).

    mean(t)    = mean + velocity sin(2 pi (t - peak) / cycle) cycle / (2 pi) still(life)
    opacity(t) = opacity exp(-(t - peak)^2 / (2 life^2))

`still` = exp(-life / (2 cycle)) is how PVG tells what moves from what stands; there it scales the
velocity that is shown, here the motion itself, so that what lives long stands exactly (ours).
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.core.numerics import namespace
from p2gs_jax.types import Gaussians, Placement

# Seconds of a vibration (PVG: ten photographs, at ten a second).
CYCLE = 1.0
# Life of what stands still, seconds: its opacity is that of all times, and no gradient reaches it.
STILL = math.exp(30.0)
# Log opacities stay within these, so that their logits are finite.
FAINTEST, MOST_OPAQUE = -30.0, -1e-6


def at_time(gaussians: Gaussians, objects: Placement | None) -> Gaussians:
    """Return Gaussians as they are at the time of a view; as they were given if none vibrates.

    Args:
        gaussians: the scene; NumPy arrays give NumPy results.
        objects: of the view, with its time; without one, the middle of the drive.
    """
    moves = gaussians.vibration
    if moves is None:
        return gaussians
    time = None if objects is None else objects.time
    t: Float[Array, ""] | np.ndarray = np.zeros((), np.float32) if time is None else time
    xp = namespace(gaussians.means, t)
    life = xp.exp(moves.log_lives)
    away = t - moves.peaks
    swing = xp.sin(away * (2 * math.pi / CYCLE)) * (CYCLE / (2 * math.pi))
    swing = swing * xp.exp(-life / (2 * CYCLE))
    log_opacity = -xp.logaddexp(0.0, -gaussians.opacity_logits) - 0.5 * (away / life) ** 2
    log_opacity = xp.clip(log_opacity, FAINTEST, MOST_OPAQUE)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means + moves.velocities * swing[:, None],
        opacity_logits=log_opacity - xp.log(-xp.expm1(log_opacity)),
        vibration=None,
    )
