"""`truth/exposures.csv`: how every photograph of a synthetic scene was exposed."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from p2gs_jax.synth.sensor import Shots

FILE = Path("truth", "exposures.csv")


def write_true_exposures(
    root: Path, names: Sequence[str], cameras: Sequence[str], shots: Shots
) -> None:
    """Write the file: image, camera, iso, exposure, exposure_ev, red, blue.

    Args:
        root: the scene folder; it has `truth/`.
        names: of the photographs.
        cameras: physical camera of each.
        shots: how they were taken.
    """
    with (root / FILE).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("image", "camera", "iso", "exposure", "exposure_ev", "red", "blue"))
        for row, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            e, (red, _, blue) = shots.exposures[row], shots.balance[row]
            exposure = (f"{e:.6g}", f"{np.log2(e):.6f}")
            writer.writerow(
                (name, camera, int(shots.iso[row]), *exposure, f"{red:.6g}", f"{blue:.6g}")
            )


def read_true_exposures(root: Path) -> dict[str, float]:
    """Return image name -> true exposure; empty where the scene has no such file.

    Args:
        root: the scene folder.
    """
    path = root / FILE
    if not path.is_file():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        return {row["image"]: float(row["exposure"]) for row in csv.DictReader(file)}
