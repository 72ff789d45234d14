"""From radiance to a picture: an exposure, a gamma, a tone curve, and what else a view does."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Literal, get_args

import jax
import numpy as np
from jaxtyping import Array, Float, Float32

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry.formation import display, formation, inverse_tone_map

Curve = Literal["power", "srgb", "spline", "linear"]
CURVES: tuple[Curve, ...] = get_args(Curve)


@dataclass(frozen=True)
class DisplayTransform:
    """How radiance is shown.

    Attributes:
        exposure: e > 0, in the run's gauge.
        gamma: > 0.
        formation: base curve, pivot, clamping, kind of correction.
        correction: of display values (photometry/appearance.py), or None.
    """

    exposure: float
    gamma: float
    formation: PhotometryConfig
    correction: Float[Array, "..."] | None = None

    def with_curve(self, curve: Curve) -> DisplayTransform:
        """Return the transform under another base curve; a correction belongs to the old one.

        Raises:
            ValueError: `spline` where the run has none.
        """
        if curve == self.formation.curve:
            return self
        if curve == "spline" and self.formation.spline is None:
            raise ValueError("the run has no spline")
        return replace(self, formation=replace(self.formation, curve=curve), correction=None)


def develop(
    linear: Float[Array, "... 3"] | Float[np.ndarray, "... 3"], transform: DisplayTransform
) -> Float32[np.ndarray, "... 3"]:
    """Return display values in [0, 1] of linear radiance.

    Exposure, gamma and correction are traced: changing them compiles nothing.

    Args:
        linear: radiance; an image where there is a correction.
        transform: how to show it.
    """
    e, g = np.float32(transform.exposure), np.float32(transform.gamma)
    return np.asarray(_develop(linear, e, g, transform.correction, transform.formation))


@functools.partial(jax.jit, static_argnames="cfg")
def _develop(linear, exposure, gamma, correction, cfg: PhotometryConfig):
    return display(formation(linear, exposure, gamma, cfg, correction))


def undevelop(
    ldr: Float[Array, "... 3"] | Float[np.ndarray, "... 3"], transform: DisplayTransform
) -> Float32[np.ndarray, "... 3"]:
    """Return the linear radiance that a photograph shows: the inverse of `develop`.

    Saturated values count as the radiance at which they saturate, values below half a code as that;
    corrections of display values are not undone.

    Args:
        ldr: display values.
        transform: how it was taken.
    """
    e, g = np.float32(transform.exposure), np.float32(transform.gamma)
    return np.asarray(_undevelop(ldr, e, g, transform.formation))


@functools.partial(jax.jit, static_argnames="cfg")
def _undevelop(ldr, exposure, gamma, cfg: PhotometryConfig):
    return inverse_tone_map(ldr, gamma, cfg) / exposure
