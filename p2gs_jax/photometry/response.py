"""From photographed values to log exposed radiance, with its uncertainty: z = F(y).

F is the logarithm of a base curve's decoding, optionally changed by a spline: F(y) = log base^-1(y)
+ B(y) c, with hat functions B over fixed knots. Host side, float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

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
DARKEST = 0.5 / 255
# Noise model: 8-bit quantisation, photon and read noise (linear units), and a floor in log units
# for what no model explains: texture, specularity, interpolation.
SHOT_NOISE, READ_NOISE, FLOOR = 2e-4, 1e-6, 0.03
# A curve with a spline may be at most this much flatter than its base, so that noise stays finite.
SMALLEST_SLOPE = 0.2


@dataclass(frozen=True)
class Response:
    """A camera's response.

    Attributes:
        base: curve that the spline is added to.
        spline: values of log exposure added at `KNOTS`, or None.
    """

    base: Base = "srgb"
    spline: tuple[float, ...] | None = None

    @property
    def name(self) -> str:
        """What reports call it."""
        return self.base if self.spline is None else f"spline over {self.base}"

    @property
    def curve(self) -> Literal["srgb", "power", "spline"]:
        """The name of the curve in `PhotometryConfig` and `photometry.json`."""
        return self.base if self.spline is None else "spline"

    @property
    def extra_parameters(self) -> int:
        """Parameters besides those of the base curve."""
        return 0 if self.spline is None else len(FREE)


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


def log_exposed(y: Float[np.ndarray, "..."], response: Response):
    """Return z = F(y) and dz/dy."""
    z, slope = base_log(y, response.base)
    if response.spline is not None:
        c = np.asarray(response.spline)
        left, t = hat(y)
        z = z + (1 - t) * c[left] + t * c[left + 1]
        steeper = (c[left + 1] - c[left]) / (KNOTS[left + 1] - KNOTS[left])
        slope = np.maximum(slope + steeper, SMALLEST_SLOPE * slope)
    return z, slope


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
    return bool(np.all(np.diff(log_exposed(y, response)[0]) > 0))


def log_slope_minimum(response: Response) -> float:
    """Return the smallest d log exposure / d log value over mid tones; a collapse shows here."""
    y = np.linspace(0.06, 0.94, 90)
    z = log_exposed(y, response)[0]
    return float(np.gradient(z, np.log(y)).min())
