"""Options and image size of synthetic data sets; numpy is not imported: `--help` is fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from p2gs_jax.errors import UserError

Curve = Literal["srgb", "power", "filmic"]
Layout = Literal["street", "town", "long"]
# Size of the paper's images, pixels.
IMAGE_WIDTH, IMAGE_HEIGHT = 1920, 1300
# Largest share of the light that a lens loses in its corners.
MOST_LOST = 0.8


def image_height(width: int, *, multiple: int = 1) -> int:
    """Return the height for a width (pixels) with the proportions of the paper's images."""
    return max(round(width * IMAGE_HEIGHT / IMAGE_WIDTH / multiple), 1) * multiple


@dataclass(frozen=True)
class Sensor:
    """The image formation of the cameras. The defaults are the paper's ISO-Var(4)."""

    iso_std: float = 4.0
    """Standard deviation of the ISO, whose mean is 8 (paper: 2 and 4); 0 is ISO-Const."""
    curve: Curve = "srgb"
    """Response; `filmic` is an S-curve before the sRGB encoding."""
    curves: tuple[Curve, ...] = ()
    """Responses that the cameras, in order of their names, get in turn; none: `curve` for all."""
    camera_gain_ev: float = 0.0
    """Standard deviation of a fixed gain per camera, stops."""
    drift_ev: float = 0.0
    """Amplitude of a slow automatic exposure, stops; each camera has another phase."""
    compensation_ev: float = 0.0
    """Stops that are added to all photographs, but not to references."""
    vignetting: float = 0.0
    """Share of the light lost in the corners."""
    vignetting_spread: float = 0.0
    """Standard deviation between cameras of the share of light lost in the corners."""
    white_balance_ev: float = 0.0
    """Standard deviation of red and blue gains per camera, stops."""
    white_balance_drift_ev: float = 0.0
    """Standard deviation of each channel's gain per photograph, stops."""
    noise: float = 0.0
    """Factor on photon and read noise; 1: a small sensor in daylight."""


# Smallest and largest values of the numbers of a Sensor.
BOUNDS = {
    "iso_std": (0, 1000),
    "camera_gain_ev": (0, 10),
    "drift_ev": (0, 10),
    "compensation_ev": (-20, 20),
    "vignetting": (0, MOST_LOST),
    "vignetting_spread": (0, 1),
    "white_balance_ev": (0, 10),
    "white_balance_drift_ev": (0, 10),
    "noise": (0, 1000),
}


def check_sensor(sensor: Sensor, prefix: str) -> None:
    """Raise UserError: a number is not finite or out of range; `prefix` begins its option."""
    for name, (least, most) in BOUNDS.items():
        value = getattr(sensor, name)
        if not (math.isfinite(value) and least <= value <= most):
            option = f"{prefix}{name.replace('_', '-')}"
            raise UserError(f"{option} is {value}, but must be from {least} to {most}.")
