"""Synthetic drives by what their cameras do to the light, and what should be found in each.

Every case is 60 views by three cameras, 8 bits, 8 % outliers (`tests/synthetic_drive.py`).
"""

from __future__ import annotations

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import Level, ResponseKind, VignettingKind
from p2gs_jax.photometry.models import ModelName
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.synth.settings import Curve

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from synthetic_drive import CAMERA_NAMES, Curves, Exposures, make_drive, make_exposures, observe

Tints = Literal["camera", "view", "dark"]
PIVOT = 0.18
FRAMES, POINTS = 20, 1200
CAMERA_GAMMAS, GAMMA_SPREAD = (2.0, 2.2, 2.45), 0.15
# Standard deviation of each channel's factor, and how much bluer dark photographs are, stops.
TINT_EV, DARK_TINT_EV = 0.1, 0.175
SHARED_TEXTURE = 0.03
# Share of the light lost in the corners: cameras x channels.
CORNERS = {
    "all": np.full((3, 1), 0.3),
    "differ": np.array([[0.15], [0.3], [0.45]]),
    "channel": np.array([[0.2, 0.3, 0.4], [0.3, 0.3, 0.15], [0.45, 0.35, 0.3]]),
}
# Responses of the three cameras, and of the three channels.
BY_CAMERA = np.array([["srgb"], ["filmic"], ["srgb"]])
BY_CHANNEL = np.array([["srgb", "filmic", "srgb"]])
_VARIES: dict[str, Level | None] = {"constant": None, "cameras": "camera"}
_MODELS: dict[tuple[Level | None, Level | None], ModelName] = {
    (None, None): "constant",
    ("camera", None): "camera_exposure",
    ("camera", "camera"): "camera_exposure_gamma",
    ("view", None): "view_exposure",
    ("view", "camera"): "view_exposure_camera_gamma",
    ("view", "view"): "view_exposure_gamma",
}


def make_white_balance(
    kind: Tints,
    cameras: Int[np.ndarray, " v"],
    exposures: Float[np.ndarray, " v"],
    *,
    ev: float = 0.1,
    seed: int = 4,
) -> Float[np.ndarray, "v 3"]:
    """Return factors on red, green, blue of every view; the mean of their logarithms is 0.

    `camera` and `view` draw factors for each; with `dark`, views darker than the median are bluer.
    `ev` is the standard deviation of a channel, or how much bluer dark views are, stops.
    """
    rng = np.random.default_rng(seed)
    if kind == "dark":
        dark = exposures < np.median(exposures)
        stops = np.where(dark[:, None], np.array([-ev / 2, 0, ev]), 0.0)
    elif kind == "camera":
        stops = ev * rng.standard_normal((int(cameras.max()) + 1, 3))[cameras]
    else:
        stops = ev * rng.standard_normal((len(cameras), 3))
    return 2.0 ** (stops - stops.mean(1, keepdims=True))


@dataclass(frozen=True)
class Case:
    """What the cameras do.

    Attributes:
        exposures: as `make_exposures` draws them.
        curve: response of all, or one that differs between cameras or channels.
        gammas: per what they vary; the curve is then a power.
        tint: white balance, as `make_white_balance` draws it.
        corners: dark corners, a key of `CORNERS`.
        shared: errors that neighbouring points have in common.
    """

    exposures: Exposures
    curve: Curve | Literal["by camera", "by channel"] = "srgb"
    gammas: Level | None = None
    tint: Tints | None = None
    corners: Literal["all", "differ", "channel"] | None = None
    shared: bool = False

    @property
    def name(self) -> str:
        """What tables call it."""
        parts = [self.exposures, self.curve]
        parts += [f"gamma per {self.gammas}"] if self.gammas else []
        if self.tint:
            parts.append("dark ones bluer" if self.tint == "dark" else f"tint per {self.tint}")
        parts += [f"corners {self.corners}"] if self.corners else []
        return ", ".join([*parts, "shared texture"] if self.shared else parts)

    @property
    def model(self) -> ModelName:
        """The model that made the photographs; with a white balance per view, one per view."""
        level = "view" if self.white_balance == "view" else _VARIES.get(self.exposures, "view")
        return _MODELS[level, self.gammas]

    @property
    def white_balance(self) -> Level | None:
        """Per what the white balance varies."""
        return None if self.tint is None else "camera" if self.tint == "camera" else "view"

    @property
    def vignetting(self) -> VignettingKind | None:
        """Whether corners are dark, and whether in each channel differently."""
        return (
            None if self.corners is None else "channel" if self.corners == "channel" else "camera"
        )

    @property
    def response(self) -> Literal["srgb", "power", "spline"] | None:
        """The curve that should be found; None where exposures do not vary enough to tell."""
        if self.exposures == "constant":
            return None
        return self.curve if self.curve in ("srgb", "power") else "spline"

    @property
    def responses(self) -> ResponseKind:
        """What has a response of its own."""
        if self.curve == "by camera":
            return "camera"
        return "channel" if self.curve == "by channel" else "all"

    @property
    def curves(self) -> Curves:
        """The responses, as `observe` takes them."""
        if self.curve == "by camera":
            return BY_CAMERA
        return BY_CHANNEL if self.curve == "by channel" else self.curve

    @property
    def plain(self) -> bool:
        """Nothing but exposures, gammas and one response."""
        return not (self.tint or self.corners) and self.responses == "all"


class Drawn(NamedTuple):
    """A case as photographed.

    Attributes:
        observations: what the solver sees.
        exposures: true, mean of the channels.
        balance: true factors on the channels.
        corners: true share of the light that reaches the corners, cameras x channels.
    """

    observations: Observations
    exposures: Float[np.ndarray, " v"]
    balance: Float[np.ndarray, "v 3"]
    corners: Float[np.ndarray, "c 3"]


def draw(case: Case, seed: int) -> Drawn:
    """Photograph a drive."""
    drive = make_drive(FRAMES, POINTS, seed)
    exposures = make_exposures(drive, case.exposures, seed + 20)
    gammas = None
    if case.gammas == "camera":
        gammas = np.array(CAMERA_GAMMAS)[drive.cameras]
    elif case.gammas == "view":
        gammas = np.random.default_rng(seed + 50).normal(2.2, GAMMA_SPREAD, len(exposures))
    balance = np.ones((len(exposures), 3))
    if case.tint is not None:
        ev = DARK_TINT_EV if case.tint == "dark" else TINT_EV
        balance = make_white_balance(case.tint, drive.cameras, exposures, ev=ev, seed=seed + 60)
    lost = None if case.corners is None else CORNERS[case.corners]
    seen = observe(
        drive,
        exposures[:, None] * balance if case.tint else exposures,
        curve=case.curves,
        gammas=gammas,
        pivot=PIVOT,
        corner_loss=lost,
        shared_texture=SHARED_TEXTURE if case.shared else 0.0,
        seed=seed + 30,
    )
    arrives = np.ones((len(CAMERA_NAMES), 3)) - (0.0 if lost is None else lost)
    return Drawn(seen, exposures, balance, arrives)


def _cases() -> list[Case]:
    every: tuple[Exposures, ...] = ("constant", "cameras", "iso2", "iso4", "auto")
    varying: tuple[Exposures, ...] = ("iso2", "iso4", "auto")
    two: tuple[Curve, ...] = ("srgb", "filmic")
    tints: tuple[Tints, ...] = ("camera", "view", "dark")
    corners = ("all", "differ", "channel")
    found = [Case(e, c) for e, c in itertools.product(every, ("srgb", "power", "filmic"))]
    found.append(Case("cameras", "power", "camera"))
    found += [Case(e, "power", g) for e, g in itertools.product(varying, ("camera", "view"))]
    # Constant exposures have no dark views; those of cameras would be one camera's.
    found += [
        Case(e, c, tint=t)
        for e, c, t in itertools.product(every, two, tints)
        if t != "dark" or e in varying
    ]
    fewer: tuple[Exposures, ...] = ("constant", "cameras", "iso4", "auto")
    found += [Case(e, c, corners=v) for e, c, v in itertools.product(fewer, two, corners)]
    found += [
        Case("auto" if t == "view" else "iso4", tint=t, corners=v)
        for t, v in itertools.product(tints, corners)
    ]
    found += [
        Case("constant", tint=t, corners=v) for t, v in itertools.product(tints[:2], corners[:2])
    ]
    found += [Case("iso2", "power", g, tint=t) for g in ("camera", "view") for t in tints[:2]]
    found += [Case("iso2", "power", g, corners="differ") for g in ("camera", "view")]
    for e, c in itertools.product(("iso4", "auto"), ("by camera", "by channel")):
        found += [Case(e, c), Case(e, c, tint="camera"), Case(e, c, corners="all")]
    found += [
        Case("constant", shared=True),
        Case("iso4", shared=True),
        Case("iso4", tint="view", shared=True),
        Case("iso4", corners="differ", shared=True),
    ]
    return found


CASES = tuple(_cases())
