"""From radiance to a picture: an exposure, a gamma, a tone curve, and what else a view does.

A transform without a camera shows no vignetting, and the response of no camera in particular.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import jax
import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.numerics import LN2, on_host
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.appearance import Correction, correction_of, mean_correction, without_place
from p2gs_jax.photometry.formation import (
    Matte,
    camera_rows,
    composited,
    display,
    formation,
    inverse_formation,
    uncovered,
)
from p2gs_jax.photometry.response import by_camera
from p2gs_jax.types import Array, Capture, Params, Photometry

Curve = Literal["power", "srgb", "spline", "linear"]
CURVES: tuple[Curve, ...] = get_args(Curve)

Balance = tuple[float, float, float]
Pixels = Float[Array, "... 3"] | Float[np.ndarray, "... 3"]
Positions = Float[np.ndarray, "... 2"] | None
Opacity = Float[Array, "h w"] | Float[np.ndarray, "h w"] | None


@dataclass(frozen=True)
class DisplayTransform:
    """How radiance is shown."""

    exposure: float  # e > 0, in the run's gauge
    gamma: float  # > 0
    formation: PhotometryConfig  # base curve, pivot, clamping, cameras, kind of correction
    correction: Correction | None = None  # of display values (photometry/appearance.py)
    # Log factors on red, green, blue beside the exposure; None: all 1.
    white_balance: Balance | None = None
    # Row in `formation.cameras`, whose vignetting and response it has; None: no camera's.
    camera: int | None = None
    # Display values that pictures are put over, after all else: of all pixels or of each.
    backdrop: Balance | Float32[np.ndarray, "h w 3"] | None = None

    @property
    def capture(self) -> Capture:
        """What it does to light, for `formation`."""
        w = self.white_balance
        return on_host(
            Capture,
            np.float32(self.exposure),
            np.float32(self.gamma),
            None if w is None else np.asarray(w, np.float32),
            None if self.camera is None else np.int32(self.camera),
        )

    @property
    def vignetting(self) -> tuple[tuple[float, ...], ...]:
        """Coefficients of its vignetting: for all channels, or for each; empty: none."""
        known = self.camera is not None and self.camera >= 0
        return self.formation.cameras[self.camera].vignetting if known else ()  # pyright: ignore

    @property
    def white_balance_ev(self) -> tuple[float, float]:
        """Gains of red and of blue over green, stops."""
        red, green, blue = self.white_balance or (0.0, 0.0, 0.0)
        return (red - green) / LN2, (blue - green) / LN2

    def matte(self, alpha: Opacity) -> Matte | None:
        """Return what a render of this opacity is put over; None: nothing, or it is not known."""
        if alpha is None or self.backdrop is None:
            return None
        return Matte(alpha, np.asarray(self.backdrop, np.float32))

    def with_white_balance_ev(self, red: float, blue: float) -> DisplayTransform:
        """Return the transform with gains of red and blue over green, stops; the exposure stays."""
        mean = (red + blue) / 3
        balance = ((red - mean) * LN2, -mean * LN2, (blue - mean) * LN2)
        return replace(self, white_balance=balance)

    def without_place(self) -> DisplayTransform:
        """Return the transform for what lies nowhere in an image: without vignetting.

        The response of the camera stays, and of a correction what is the same everywhere.
        """
        kept = without_place(self.correction, self.formation.appearance)
        plain = self if kept is self.correction else replace(self, correction=kept)
        if self.camera is None:
            return plain
        cameras = tuple(replace(c, vignetting=()) for c in self.formation.cameras)
        return replace(plain, formation=replace(self.formation, cameras=cameras))

    def with_curve(self, curve: Curve) -> DisplayTransform:
        """Return the transform under another base curve; a correction belongs to the old one.

        Raises UserError: `spline` where the run has none.
        """
        if curve == self.formation.curve:
            return self
        if curve == "spline" and self.formation.spline is None and not by_camera(self.formation):
            fix = f"choose another, or leave it out for the run's own ({self.formation.curve})"
            raise UserError("The curve cannot be spline: the run has no spline.", fix=fix)
        return replace(self, formation=replace(self.formation, curve=curve), correction=None)


def develop(
    linear: Pixels, transform: DisplayTransform, positions: Positions = None, alpha: Opacity = None
) -> Float32[np.ndarray, "... 3"]:
    """Return display values in [0, 1] of linear radiance.

    All but the configuration is traced: changing it compiles nothing. Where there is a
    correction or vignetting, the radiance is an image, or lies at `positions`
    (photometry/formation.py:places). The transform's backdrop counts if the opacity `alpha` of
    the render is given.
    """
    how = (transform.capture, transform.correction, positions, transform.matte(alpha))
    return np.asarray(_develop(linear, *how, transform.formation))


@functools.partial(jax.jit, static_argnames="cfg")
def _develop(linear, capture, correction, positions, matte, cfg: PhotometryConfig):
    own = formation(uncovered(linear, matte), capture, cfg, correction, positions)
    return composited(display(own), matte)


def undevelop(
    ldr: Pixels, transform: DisplayTransform, positions: Positions = None
) -> Float32[np.ndarray, "... 3"]:
    """Return the linear radiance that a photograph shows: the inverse of `develop`, on the host.

    Saturated values count as the radiance at which they saturate, values below half a code as that;
    corrections of display values are not undone. `positions` as for `develop`.
    """
    shown = np.asarray(ldr, np.float32)
    return inverse_formation(shown, transform.capture, transform.formation, positions)


def display_of_view(params: Params, row: int, cfg: PhotometryConfig) -> DisplayTransform:
    """Return how the training view in a row was taken; compiles nothing of host arrays."""
    taken = jax.tree.map(np.asarray, params.photometry).capture(row)
    plain = DisplayTransform(1.0, 1.0, cfg, correction_of(params.appearance, row))
    return with_capture(plain, taken)


def with_capture(transform: DisplayTransform, taken: Capture) -> DisplayTransform:
    """Return a transform that does to light what a photograph did."""
    return replace(
        transform,
        exposure=float(taken.exposure),
        gamma=float(taken.gamma),
        white_balance=_balance(taken.white_balance),
        camera=None if taken.camera is None else int(taken.camera),
    )


@dataclass(frozen=True)
class MeanParameters:
    """Parameters of a view that has none of its own: means over the training views."""

    exposure: float  # arithmetic mean (paper, eq. 6)
    exposure_geometric: float  # geometric mean, which the gauges leave in place
    gamma: float  # arithmetic mean
    # Mean of the log factors, or None where white balance is not modelled.
    white_balance: Balance | None = None


def mean_parameters(photometry: Photometry) -> MeanParameters:
    """Return the means over the training views."""
    taken: Photometry = jax.tree.map(np.asarray, photometry)
    e = taken.exposures.astype(np.float64)
    return MeanParameters(
        float(e.mean()),
        float(np.exp(np.log(e).mean())),
        float(taken.gammas.astype(np.float64).mean()),
        _mean_balance(taken),
    )


def usual_display(
    params: Params, taken_by: Sequence[str], camera: str | None, cfg: PhotometryConfig
) -> DisplayTransform:
    """Return how a view of a camera (None: of none) is shown that has no parameters of its own.

    Its exposure is the geometric mean over the training views, its gamma and its correction are
    the mean ones. Its white balance is the mean over all training views, or over those of its
    camera where it varies by camera only. Its vignetting and its response are its camera's,
    those of a correction as well. `taken_by` is the camera of every training view.
    """
    taken: Photometry = jax.tree.map(np.asarray, params.photometry)
    mean = mean_parameters(taken)
    balance = mean.white_balance
    own = np.array([name == camera for name in taken_by], bool)
    if cfg.white_balance == "camera" and own.any():
        balance = _mean_balance(taken, own)
    correction = mean_correction(params.appearance, camera)
    rows = None if camera is None else camera_rows((camera,), cfg)
    row = None if rows is None else rows[0]
    return DisplayTransform(mean.exposure_geometric, mean.gamma, cfg, correction, balance, row)


def _mean_balance(photometry: Photometry, rows: Any = slice(None)) -> Balance | None:
    balance = photometry.white_balance
    return None if balance is None else _balance(np.asarray(balance, np.float64)[rows].mean(0))


def _balance(logs: Float[Array, " 3"] | Float[np.ndarray, " 3"] | None) -> Balance | None:
    return None if logs is None else tuple(map(float, logs))  # pyright: ignore[reportReturnType]
