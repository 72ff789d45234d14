"""`truth/exposures.csv`: how every photograph of a synthetic scene was taken.

Columns: image, camera, iso, exposure, exposure_ev, red, green, blue (factors beside the exposure;
their product is 1), corners (share of the light that reaches them), curve.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p2gs_jax.synth.sensor import Shots

FILE = Path("truth", "exposures.csv")
COLUMNS = (
    *("image", "camera", "iso", "exposure", "exposure_ev", "red", "green", "blue"),
    *("corners", "curve"),
)


def write_true_exposures(
    root: Path, names: Sequence[str], cameras: Sequence[str], shots: Shots
) -> None:
    """Write the file.

    Args:
        root: the scene folder; it has `truth/`.
        names: of the photographs.
        cameras: physical camera of each.
        shots: how they were taken.
    """
    with (root / FILE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        exposures, tints = shots.mean_exposures, shots.tints
        for row, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            e = exposures[row]
            factors = (f"{factor:.6g}" for factor in tints[row])
            corners = f"{1 - shots.corner_loss[row]:.6g}"
            exposure = (f"{e:.6g}", f"{np.log2(e):.6f}")
            iso = int(shots.iso[row])
            writer.writerow((name, camera, iso, *exposure, *factors, corners, shots.curves[row]))


def read_true_exposures(root: Path) -> dict[str, float]:
    """Return image name -> true exposure; empty where the scene has no such file.

    Args:
        root: the scene folder.
    """
    return {row["image"]: float(row["exposure"]) for row in _rows(root)}


class TrueShot(NamedTuple):
    """How a photograph was taken.

    Attributes:
        camera: physical camera.
        exposure: factor on radiance, mean over the channels.
        balance: factors on red, green, blue beside it; their product is 1.
        corners: share of the light that reaches the corners.
    """

    camera: str
    exposure: float
    balance: tuple[float, float, float]
    corners: float


def read_true_shots(root: Path) -> dict[str, TrueShot]:
    """Return image name -> how it was taken; empty where the scene has no such file.

    Args:
        root: the scene folder.
    """
    return {
        row["image"]: TrueShot(
            row["camera"],
            float(row["exposure"]),
            (float(row["red"]), float(row["green"]), float(row["blue"])),
            float(row["corners"]),
        )
        for row in _rows(root)
    }


def _rows(root: Path) -> list[dict[str, str]]:
    path = root / FILE
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
