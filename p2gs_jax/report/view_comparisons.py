"""Views for the page: photograph, render and radiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.errors import UserError
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.report.run_files import HeldOutFiles, RunFiles, number_at


@dataclass(frozen=True)
class ViewComparison:
    """A photograph and its render.

    Attributes:
        name: of the view.
        split: train or test.
        photograph: display values.
        render: under the view's own exposure, or that fitted to its photograph.
        linear: radiance, or None.
        psnr: of the render, dB, or None if unknown.
    """

    name: str
    split: str
    photograph: Float32[np.ndarray, "h w 3"]
    render: Float32[np.ndarray, "h w 3"]
    linear: Float32[np.ndarray, "h w 3"] | None
    psnr: float | None


def held_out_comparisons(run: RunFiles, most: int, problems: list[str]) -> list[ViewComparison]:
    """Return held-out views from files: evenly over all of them, the worst first.

    Args:
        run: the folder.
        most: views at most.
        problems: receives a sentence for every view that could not be read.
    """
    scores = run.part("test", "exposure_fitted", "per_view")
    ranked = sorted(run.held_out, key=lambda h: (_psnr(scores, h), h.name))
    out = []
    for files in spread(ranked, most):
        try:
            out.append(
                ViewComparison(
                    files.name,
                    "test",
                    read_png(files.photograph),
                    read_png(files.render),
                    None if files.exr is None else read_exr(files.exr)[0],
                    number_at(scores, files.name, "psnr"),
                )
            )
        except UserError as error:
            problems.append(f"{files.name} is not shown: {error.message}.")
    return out


def _psnr(scores: dict, files: HeldOutFiles) -> float:
    value = number_at(scores, files.name, "psnr")
    return float("inf") if value is None else value


def spread(items: Sequence, most: int) -> list:
    """Return at most `most` items, evenly spaced, the first and the last included."""
    return [items[i] for i in evenly_spaced(len(items), most)]


def read_png(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Return display values of a PNG or JPEG.

    Raises:
        UserError: it cannot be read.
    """
    try:
        raw = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        raw = None
    if raw is None:
        raise UserError(f"{path} cannot be read")
    return raw[..., ::-1].astype(np.float32) / 255
