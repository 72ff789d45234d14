"""From radiance to a picture: exposure, gamma, tone curve and other parameters of a view.

A transform without a camera has no vignetting, and the common or mean response of all cameras.
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
from p2gs_jax.photometry.response import DARKEST, by_camera
from p2gs_jax.types import Array, Capture, Params, Photometry

Curve = Literal["power", "srgb", "spline", "linear"]

Balance = tuple[float, float, float]
Pixels = Float[Array, "... 3"] | Float[np.ndarray, "... 3"]
Positions = Float[np.ndarray, "... 2"] | None
Opacity = Float[Array, "h w"] | Float[np.ndarray, "h w"] | None


@dataclass(frozen=True)
class DisplayTransform:
    """Parameters of the map from radiance to display values."""

    exposure: float  # e > 0, in the run's gauge
    gamma: float  # > 0
    formation: PhotometryConfig  # base curve, pivot, clamping, cameras, kind of correction
    correction: Correction | None = None  # of display values (photometry/appearance.py)
    # Log factors on red, green, blue beside the exposure; None: all factors are 1.
    white_balance: Balance | None = None
    # Row in `formation.cameras` of the vignetting and the response; None: no camera.
    camera: int | None = None
    # Display values of the background of pictures: one for all pixels, or one for each pixel.
    backdrop: Balance | Float32[np.ndarray, "h w 3"] | None = None

    @property
    def capture(self) -> Capture:
        """The parameters of the view for `formation`."""
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
        """Coefficients of the vignetting: one row, or one per channel; empty: no vignetting."""
        known = self.camera is not None and self.camera >= 0
        return self.formation.cameras[self.camera].vignetting if known else ()  # pyright: ignore

    @property
    def white_balance_ev(self) -> tuple[float, float]:
        """Gains of red and of blue over green, stops."""
        red, green, blue = self.white_balance or (0.0, 0.0, 0.0)
        return (red - green) / LN2, (blue - green) / LN2

    def matte(self, alpha: Opacity) -> Matte | None:
        """Return the background of a render of this opacity; None: there is none."""
        if alpha is None or self.backdrop is None:
            return None
        return Matte(alpha, np.asarray(self.backdrop, np.float32))

    def with_white_balance_ev(self, red: float, blue: float) -> DisplayTransform:
        """Return the transform with gains of red and blue over green, stops; the exposure stays."""
        mean = (red + blue) / 3
        balance = ((red - mean) * LN2, -mean * LN2, (blue - mean) * LN2)
        return replace(self, white_balance=balance)

    def without_place(self) -> DisplayTransform:
        """Return the transform for colours without a position in an image: without vignetting.

        The response of the camera stays, and the part of a correction that is equal everywhere.
        """
        correction = without_place(self.correction, self.formation.appearance)
        plain = self if correction is self.correction else replace(self, correction=correction)
        if self.camera is None:
            return plain
        cameras = tuple(replace(c, vignetting=()) for c in self.formation.cameras)
        return replace(plain, formation=replace(self.formation, cameras=cameras))

    def with_curve(self, curve: Curve) -> DisplayTransform:
        """Return the transform under another base curve, without the correction of the old curve.

        Raises UserError: the curve is unknown, or it is `spline` and the run has none.
        """
        if curve not in get_args(Curve):
            raise UserError(f"{curve!r} is not a curve.", fix=f"use {', '.join(get_args(Curve))}")
        if curve == self.formation.curve:
            return self
        if curve == "spline" and self.formation.spline is None and not by_camera(self.formation):
            fix = f"choose another, or leave it out to use the run's ({self.formation.curve})"
            raise UserError("The curve cannot be spline: the run has no spline.", fix=fix)
        return replace(self, formation=replace(self.formation, curve=curve), correction=None)


def develop(
    linear: Pixels, transform: DisplayTransform, positions: Positions = None, alpha: Opacity = None
) -> Float32[np.ndarray, "... 3"]:
    """Return display values in [0, 1] of linear radiance.

    A new `formation` or shape compiles a new program, but new values do not. With a correction or
    vignetting, radiance is an image, or lies at `positions` (photometry/formation.py:places). The
    backdrop of the transform is shown if the opacity `alpha` of the render is given.
    """
    traced = (transform.capture, transform.correction, positions, transform.matte(alpha))
    return np.asarray(_develop(linear, *traced, transform.formation))


@functools.partial(jax.jit, static_argnames="cfg")
def _develop(linear, capture, correction, positions, matte, cfg: PhotometryConfig):
    ldr = formation(uncovered(linear, matte), capture, cfg, correction, positions)
    return composited(display(ldr), matte)


def undevelop(
    ldr: Pixels, transform: DisplayTransform, positions: Positions = None
) -> Float32[np.ndarray, "... 3"]:
    """Return the linear radiance that a photograph shows: the inverse of `develop`, on the host.

    Saturated values give the radiance at which they saturate. Values below half an 8-bit code count
    as half a code. Corrections of display values are not undone. `positions` are as for `develop`.
    """
    values = np.asarray(ldr, np.float32)
    return inverse_formation(values, transform.capture, transform.formation, positions)


def light_of(ldr: Pixels, transform: DisplayTransform) -> Float32[np.ndarray, "... 3"]:
    """Return the linear radiance of display values like `undevelop`, but 0 for 0.

    Below half an 8-bit code it is proportional to the value, so that empty pixels stay black under
    every exposure. Values above 1 count as 1, unless the curve is linear.
    """
    most = np.inf if transform.formation.curve == "linear" else 1
    values = np.clip(np.asarray(ldr, np.float32), 0, most)
    return undevelop(values, transform) * np.minimum(values / np.float32(DARKEST), 1)


def display_of_view(params: Params, row: int, cfg: PhotometryConfig) -> DisplayTransform:
    """Return the transform of the training view in a row; host arrays compile no program."""
    capture = jax.tree.map(np.asarray, params.photometry).capture(row)
    plain = DisplayTransform(1.0, 1.0, cfg, correction_of(params.appearance, row))
    return with_capture(plain, capture)


def with_capture(transform: DisplayTransform, capture: Capture) -> DisplayTransform:
    """Return a transform with the photometric parameters of a photograph."""
    return replace(
        transform,
        exposure=float(capture.exposure),
        gamma=float(capture.gamma),
        white_balance=_balance(capture.white_balance),
        camera=None if capture.camera is None else int(capture.camera),
    )


@dataclass(frozen=True)
class MeanParameters:
    """Parameters of views that were not fitted: means over the training views."""

    exposure: float  # arithmetic mean (paper, eq. 6)
    exposure_geometric: float  # geometric mean, which the gauges do not change
    gamma: float  # arithmetic mean
    # Mean of the log factors; None if white balance is not modelled.
    white_balance: Balance | None = None


def mean_parameters(photometry: Photometry) -> MeanParameters:
    """Return the means over the training views."""
    host: Photometry = jax.tree.map(np.asarray, photometry)
    e = host.exposures.astype(np.float64)
    return MeanParameters(
        float(e.mean()),
        float(np.exp(np.log(e).mean())),
        float(host.gammas.astype(np.float64).mean()),
        _mean_balance(host),
    )


def usual_display(
    params: Params, cameras: Sequence[str], camera: str | None, cfg: PhotometryConfig
) -> DisplayTransform:
    """Return the transform of a view that was not fitted; `camera` is None if the view has none.

    The exposure is the geometric mean over the training views; gamma and correction are arithmetic
    means. The white balance is the mean over all training views, or over the views of the camera if
    it varies by camera only. Vignetting and response, also in a correction, come from the camera.
    `cameras` lists the camera of every training view.
    """
    photometry: Photometry = jax.tree.map(np.asarray, params.photometry)
    mean = mean_parameters(photometry)
    balance = mean.white_balance
    rows_of_camera = np.array([name == camera for name in cameras], bool)
    if cfg.white_balance == "camera" and rows_of_camera.any():
        balance = _mean_balance(photometry, rows_of_camera)
    correction = mean_correction(params.appearance, camera)
    rows = None if camera is None else camera_rows((camera,), cfg)
    row = None if rows is None else rows[0]
    return DisplayTransform(mean.exposure_geometric, mean.gamma, cfg, correction, balance, row)


def _mean_balance(photometry: Photometry, rows: Any = slice(None)) -> Balance | None:
    balance = photometry.white_balance
    return None if balance is None else _balance(np.asarray(balance, np.float64)[rows].mean(0))


def _balance(logs: Float[Array, " 3"] | Float[np.ndarray, " 3"] | None) -> Balance | None:
    return None if logs is None else tuple(map(float, logs))  # pyright: ignore[reportReturnType]
