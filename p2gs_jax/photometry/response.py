"""From photographed values to log exposed radiance, with its uncertainty: z = F(y).

F is the logarithm of a base curve's decoding, optionally changed by a spline: F(y) = log base^-1(y)
+ B(y) c, with hat functions B over fixed knots; cameras or channels may have splines of their own.
Host side, float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import ResponseKind

Base = Literal["srgb", "power"]
BASES: tuple[Base, ...] = ("srgb", "power")
# The spline's knots in display values; two of them are held, which fixes scale and power.
KNOTS = np.array(
    [
        *(0.02, 0.05, 0.08, 0.12, 0.16, 0.21, 0.26, 0.32, 0.38, 0.44),
        *(0.5, 0.56, 0.62, 0.68, 0.74, 0.8, 0.86, 0.9, 0.94, 0.98),
    ]
)
HELD = (6, 16)
FREE = tuple(k for k in range(len(KNOTS)) if k not in HELD)
FREE_OF_EACH = tuple(k for k in range(len(KNOTS)) if k != HELD[0])
DARKEST = 0.5 / 255
# Noise model: 8-bit quantisation, photon and read noise (linear units), and a floor in log units
# for what no model explains: texture, specularity, interpolation.
SHOT_NOISE, READ_NOISE, FLOOR = 2e-4, 1e-6, 0.03
# A curve with a spline may be at most this much flatter than its base, so that noise stays finite.
SMALLEST_SLOPE = 0.2


@dataclass(frozen=True)
class Response:
    """A response: one for all photographs, or one for each camera or channel.

    Attributes:
        base: curve that splines are added to.
        spline: values of log exposure added at `KNOTS`, or None; where several are, their mean.
        by: what has a spline of its own.
        splines: of each camera, or of red, green and blue; empty where one is for all.
    """

    base: Base = "srgb"
    spline: tuple[float, ...] | None = None
    by: ResponseKind = "all"
    splines: tuple[tuple[float, ...], ...] = ()

    @property
    def name(self) -> str:
        """What reports call it."""
        if self.spline is None:
            return self.base
        each = "" if self.by == "all" else f" per {self.by}"
        return f"spline{each} over {self.base}"

    @property
    def curve(self) -> Literal["srgb", "power", "spline"]:
        """The name of the curve in `PhotometryConfig` and `photometry.json`."""
        return self.base if self.spline is None else "spline"

    @property
    def extra_parameters(self) -> int:
        """Parameters besides those of the base curve."""
        return spline_parameters(None if self.spline is None else self.by, len(self.splines))

    @property
    def each(self) -> tuple[tuple[float, ...], ...]:
        """All its splines."""
        if self.spline is None:
            return ()
        return self.splines or (self.spline,)

    @property
    def parts(self) -> tuple[Response, ...]:
        """Its curves, one for all channels each: of every camera or channel with its own."""
        return tuple(Response(self.base, spline) for spline in self.each) or (self,)


def free_knots(by: ResponseKind) -> tuple[int, ...]:
    """Return the knots that are solved for: of several splines, the powers differ as well."""
    return FREE if by == "all" else FREE_OF_EACH


def spline_count(by: ResponseKind | None, cameras: int) -> int:
    """Return how many splines there are.

    Args:
        by: what has one of its own; None: nothing.
        cameras: number of physical cameras.
    """
    return {None: 0, "all": 1, "camera": cameras, "channel": 3}[by]


def spline_parameters(by: ResponseKind | None, cameras: int) -> int:
    """Return the number of free parameters of all splines; arguments as for `spline_count`."""
    if by is None:
        return 0
    # Of several, each with a power and a shape, one power is a gauge.
    return spline_count(by, cameras) * len(free_knots(by)) - (by != "all")


def spline_groups(
    by: ResponseKind, cameras: Int[np.ndarray, " o"], shape: tuple[int, ...]
) -> Int[np.ndarray, "o 3"]:
    """Return which spline decodes each value.

    Args:
        by: what has one of its own.
        cameras: of each observation.
        shape: of the values: observations and channels.
    """
    if by == "camera":
        return np.broadcast_to(cameras[:, None], shape)
    return np.broadcast_to(np.arange(3) if by == "channel" else 0, shape)


def hat(y: Float[np.ndarray, "..."]) -> tuple[Int[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Return the left knot of each value and the fraction of the way to the next one."""
    left = np.clip(np.searchsorted(KNOTS, y) - 1, 0, len(KNOTS) - 2)
    return left, np.clip((y - KNOTS[left]) / (KNOTS[left + 1] - KNOTS[left]), 0, 1)


def base_log(y: Float[np.ndarray, "..."], base: Base):
    """Return log of the decoded value and its derivative by the display value."""
    y = np.clip(y, DARKEST, 1.0)
    if base == "power":
        return 2.2 * np.log(y), 2.2 / y
    toe = y <= 0.04045
    high = (y + 0.055) / 1.055
    return (
        np.where(toe, np.log(y / 12.92), 2.4 * np.log(high)),
        np.where(toe, 1 / y, 2.4 / (y + 0.055)),
    )


def log_exposed(
    y: Float[np.ndarray, "..."],
    response: Response,
    cameras: Int[np.ndarray, " o"] | None = None,
):
    """Return z = F(y) and dz/dy.

    Args:
        y: display values; (o, 3) where splines are several.
        response: the curve.
        cameras: of each observation, where cameras have splines of their own.
    """
    z, slope = base_log(y, response.base)
    if response.spline is None:
        return z, slope
    table = np.asarray(response.each, np.float64)
    group: Int[np.ndarray, "..."] | int = 0
    if response.splines:
        of_camera = np.zeros(len(y), int) if cameras is None else cameras
        group = spline_groups(response.by, of_camera, np.shape(y))
    left, t = hat(y)
    low, high = table[group, left], table[group, left + 1]
    steeper = (high - low) / (KNOTS[left + 1] - KNOTS[left])
    return z + (1 - t) * low + t * high, np.maximum(slope + steeper, SMALLEST_SLOPE * slope)


def deviation(
    y: Float[np.ndarray, "..."],
    slope: Float[np.ndarray, "..."],
    spread: Float[np.ndarray, "..."] | float = 0.0,
    base: Base = "srgb",
) -> Float[np.ndarray, "..."]:
    """Return the standard deviation of z.

    Args:
        y: photographed values.
        slope: dz/dy.
        spread: standard deviation in display values from misplacement and blur.
        base: curve by which photon noise is judged.
    """
    exposed = np.exp(base_log(y, base)[0])
    base_slope = base_log(y, base)[1]
    shot = np.sqrt(SHOT_NOISE * exposed + READ_NOISE) / exposed * slope / base_slope
    return np.sqrt((slope / (255 * np.sqrt(12))) ** 2 + shot**2 + (slope * spread) ** 2 + FLOOR**2)


def monotone(response: Response) -> bool:
    """Return whether the response rises everywhere between its outer knots."""
    y = np.linspace(KNOTS[0], KNOTS[-1], 400)
    return all(np.all(np.diff(log_exposed(y, one)[0]) > 0) for one in response.parts)


def log_slope_minimum(response: Response) -> float:
    """Return the smallest d log exposure / d log value over mid tones; a collapse shows here."""
    y = np.linspace(0.06, 0.94, 90)
    logs = [log_exposed(y, one)[0] for one in response.parts]
    return min(float(np.gradient(z, np.log(y)).min()) for z in logs)
