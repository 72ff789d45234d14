"""The cameras' pipeline: ISO drawn per photograph, sRGB, eight bits (paper, appendix "Exposure
Control"), and optional effects of real cameras: a filmic curve, gains, drift, vignetting, white
balance, a lens and a curve per camera, noise.

The exposure is ISO / 8 times the gains, so ISO-Const photographs (ISO 8) have an exposure of 1.

`truth/exposures.csv` has a row per photograph: image, camera, iso, exposure, exposure_ev, red,
green, blue (factors relative to the exposure; their product is 1), corners (share of the light that
reaches the corners), curve.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from p2gs_jax.core.atomic import readable
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.core.streams import SceneStream, generator
from p2gs_jax.core.text import read_csv
from p2gs_jax.errors import UserError
from p2gs_jax.synth.settings import MOST_LOST, Curve, Sensor

ISO_REFERENCE, ISO_MINIMUM = 8, 1
# Variances of photon noise per unit of exposed radiance, and of read noise.
SHOT_NOISE, READ_NOISE = 2e-4, 1e-6
DRIFT_PERIODS = 1.3  # of the automatic exposure in a drive
FILE = Path("truth", "exposures.csv")
COLUMNS = (
    *("image", "camera", "iso", "exposure", "exposure_ev"),
    *("red", "green", "blue", "corners", "curve"),
)


class Shots(NamedTuple):
    """Camera settings of every photograph: factors on radiance (ISO-Const without gains: 1) and on
    red, green, blue; share of the light lost in the corners; tone curve."""

    iso: Int[np.ndarray, " v"]
    exposures: Float[np.ndarray, " v"]
    balance: Float[np.ndarray, "v 3"]
    corner_loss: Float[np.ndarray, " v"]
    curves: tuple[Curve, ...]

    @property
    def mean_exposures(self) -> Float[np.ndarray, " v"]:
        """Exposures without white balance: the geometric means over the channels."""
        return self.exposures * np.exp(np.log(self.balance).mean(1))

    @property
    def tints(self) -> Float[np.ndarray, "v 3"]:
        """Factors on red, green, blue relative to `mean_exposures`; their product is 1."""
        return self.balance / np.exp(np.log(self.balance).mean(1, keepdims=True))

    def sensor(self, sensor: Sensor, row: int) -> Sensor:
        """Return the pipeline of one photograph."""
        lost = float(self.corner_loss[row])
        return dataclasses.replace(sensor, curve=self.curves[row], vignetting=lost)


def draw_iso(shape: tuple[int, ...], std: float, seed: int) -> Int[np.ndarray, "..."]:
    """Return a draw of ISO ~ N(8, std) per photograph (paper: 2 and 4), rounded, at least 1."""
    noise = generator(seed, SceneStream.ISO).standard_normal(shape)
    return np.maximum(np.rint(ISO_REFERENCE + std * noise), ISO_MINIMUM).astype(np.int64)


def draw_shots(sensor: Sensor, frames: int, cameras: int, seed: int) -> Shots:
    """Return the camera settings of all photographs, ordered by camera, then by frame."""
    if len(sensor.curves) not in (0, cameras):
        fix = f"name {cameras} curves, or none"
        raise UserError(f"there are {cameras} cameras, but {len(sensor.curves)} curves.", fix=fix)
    iso = draw_iso((frames, cameras), sensor.iso_std, seed).T.ravel()
    rng = generator(seed, SceneStream.CAMERAS)
    gain = sensor.camera_gain_ev * rng.standard_normal(cameras)
    tint = sensor.white_balance_ev * rng.standard_normal((cameras, 2))
    phase = 2 * np.pi * rng.random(cameras)
    turn = 2 * np.pi * DRIFT_PERIODS * np.arange(frames) / max(frames, 1)
    stops = gain[:, None] + sensor.drift_ev * np.sin(turn + phase[:, None])
    stops += sensor.compensation_ev
    balance = np.exp2(np.stack([tint[:, 0], np.zeros(cameras), tint[:, 1]], 1))
    optics = generator(seed, SceneStream.OPTICS)
    lost = sensor.vignetting + sensor.vignetting_spread * optics.standard_normal(cameras)
    drift = sensor.white_balance_drift_ev * optics.standard_normal((cameras * frames, 3))
    balance = np.repeat(balance, frames, axis=0)
    return Shots(
        iso,
        iso / ISO_REFERENCE * np.exp2(stops.ravel()),
        balance * np.exp2(drift - drift.mean(1, keepdims=True)),
        np.repeat(np.clip(lost, 0, MOST_LOST), frames),
        tuple(c for c in sensor.curves or (sensor.curve,) * cameras for _ in range(frames)),
    )


def encode(exposed: Float[np.ndarray, "..."], curve: Curve) -> Float[np.ndarray, "..."]:
    """Return display values of exposed radiance, not yet rounded."""
    if curve == "power":
        return np.clip(exposed, 0.0, 1.0) ** (1 / 2.2)
    if curve == "filmic":
        # The S-curve of film and game engines (Narkowicz's fit), before the sRGB encoding.
        x = 0.8 * exposed
        exposed = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    return srgb_encode(exposed)


def vignette(height: int, width: int, lost: float) -> Float[np.ndarray, "h w 1"]:
    """Return the light that reaches each pixel: 1 in the centre, 1 - lost in the corners.

    Circles around the centre are equally bright, as behind a lens.
    """
    y, x = np.mgrid[:height, :width] + 0.5
    squared = (x - width / 2) ** 2 + (y - height / 2) ** 2
    return (1 - lost * squared / ((width / 2) ** 2 + (height / 2) ** 2))[..., None]


def photograph(
    linear: Float[np.ndarray, "h w 3"],
    exposure: float,
    sensor: Sensor | None = None,
    *,
    balance: Float[np.ndarray, " 3"] | None = None,
    rng: np.random.Generator | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the eight-bit photograph of linear radiance times an exposure.

    Without a sensor the tone curve is sRGB. `balance` has factors on red, green, blue. Noise needs
    an `rng`.
    """
    sensor = sensor or Sensor()
    exposed = np.asarray(linear, np.float64) * exposure
    if balance is not None:
        exposed = exposed * balance
    if sensor.vignetting:
        exposed = exposed * vignette(*exposed.shape[:2], sensor.vignetting)
    if sensor.noise:
        assert rng is not None
        deviation = sensor.noise * np.sqrt(SHOT_NOISE * exposed + READ_NOISE)
        exposed = np.maximum(exposed + deviation * rng.standard_normal(exposed.shape), 0.0)
    return np.rint(255.0 * encode(exposed, sensor.curve)).astype(np.uint8)


def write_true_exposures(root: Path, names: Sequence[str], shots: Shots) -> None:
    """Write the settings of the photographs (CAMERA/FILE) into `truth/` of a scene folder."""
    with (root / FILE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        exposures, tints = shots.mean_exposures, shots.tints
        for row, name in enumerate(names):
            camera = name.split("/")[0]
            e, iso = exposures[row], int(shots.iso[row])
            factors = (f"{x:.6g}" for x in (*tints[row], 1 - shots.corner_loss[row]))
            exposure = (f"{e:.6g}", f"{np.log2(e):.6f}")
            writer.writerow((name, camera, iso, *exposure, *factors, shots.curves[row]))


def read_true_exposures(root: Path) -> dict[str, float]:
    """Return true exposures by image name; empty if the scene folder has no such file.

    Raises UserError: the file lacks a column, a row is too long, or a value is not a number.
    """
    path = root / FILE
    if not path.is_file():
        return {}
    with (
        readable(path, "correct or remove the file: only the evaluation uses it"),
        path.open(newline="", encoding="utf-8-sig") as file,
    ):
        return {row["image"]: float(row["exposure"]) for _, row in read_csv(path, file)[1]}
