"""`photometry.json`: what each camera did to the light, for other tools to read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.numerics import LN2
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.types import View

MEAN_GAUGE = "mean log exposure is 0 over each connected group of views"
# Absent from files of runs without a bundle adjustment.
OPTIONAL = frozenset({"exposure_ev_error", "gamma_error", "exposure_ev_start", "observations"})


class ViewPhotometry(TypedDict):
    """One view.

    Attributes:
        image: name in the scene.
        camera: physical camera.
        exposure: e > 0, or null for a held-out view, which has none.
        exposure_ev: log2 of it.
        gamma: gamma, or null.
        exif_ev: log2(t ISO / N^2) from EXIF, or null.
        split: train or test.
        exposure_fitted: for a held-out view, the scalar solved from its photograph.
        exposure_ev_error: standard error of `exposure_ev` from the bundle adjustment, or null.
        gamma_error: standard error of `gamma`, or null.
        exposure_ev_start: `exposure_ev` before the first step, where a bundle adjustment gave it.
        observations: usable observations of shared points that it had in this view.
    """

    image: str
    camera: str
    exposure: float | None
    exposure_ev: float | None
    gamma: float | None
    exif_ev: float | None
    split: str
    exposure_fitted: float | None
    exposure_ev_error: NotRequired[float | None]
    gamma_error: NotRequired[float | None]
    exposure_ev_start: NotRequired[float | None]
    observations: NotRequired[int | None]


class PhotometryFile(TypedDict):
    """The file: model, tone curve, gauge, mean parameters, views."""

    model: str
    curve: dict
    gauge: str
    mean: dict
    views: list[ViewPhotometry]


def write_photometry(
    path: Path, *, model: str, curve: dict, gauge: str, mean: dict, views: list[ViewPhotometry]
) -> None:
    """Write the file atomically.

    Raises:
        ValueError: a view lacks a field.
    """
    data = {"model": model, "curve": curve, "gauge": gauge, "mean": mean, "views": views}
    if problem := _problem(data):
        raise ValueError(problem)
    write_json(path, data)


def write_solution(
    path: Path,
    solution: PhotometricSolution,
    *,
    views: Sequence[View],
    pivot: float,
    known: str | None,
    gauge: str,
) -> None:
    """Write the file from a photometric solution; views it knows nothing about get nulls.

    Args:
        path: the file.
        solution: exposures, gammas, response.
        views: its views, in order.
        pivot: linear value that gammas leave alone.
        known: where known exposures came from, or None.
        gauge: what fixes the scale where none are known, in words.
    """
    s = solution
    seen = np.isfinite(s.exposure_errors)
    e = np.exp(s.log_exposures[seen])
    rows: list[ViewPhotometry] = []
    for i, view in enumerate(views):
        values = (
            np.exp(s.log_exposures[i]),
            s.exposures_ev[i],
            s.exposure_errors[i] / LN2,
            s.gammas[i],
            s.gamma_errors[i],
        )
        exposure, ev, ev_error, gamma, gamma_error = (float(v) if seen[i] else None for v in values)
        rows.append(
            {
                "image": view.name,
                "camera": view.camera,
                "exposure": exposure,
                "exposure_ev": ev,
                "exposure_ev_error": ev_error,
                "gamma": gamma,
                "gamma_error": gamma_error,
                "exif_ev": view.exif_ev,
                "split": "train",
                "exposure_fitted": None,
            }
        )
    write_photometry(
        path,
        model=s.model,
        curve={"name": s.response.curve, "pivot": pivot, "spline": s.response.spline},
        gauge=gauge if known is None else f"known exposures ({known})",
        mean={
            "exposure": float(e.mean()) if e.size else 1.0,
            "exposure_geometric": float(np.exp(np.log(e).mean())) if e.size else 1.0,
            "gamma": float(s.gammas.mean()),
        },
        views=rows,
    )


AGAIN = "restore it from a copy, or run `p2gs-jax fit ... --resume` or `calibrate` again"


def read_photometry(path: Path) -> PhotometryFile:
    """Read the file.

    Raises:
        UserError: it is no such file.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}.", fix=AGAIN) from error
    if problem := _problem(data):
        raise UserError(f"{path} is incomplete: {problem}.", fix=AGAIN)
    return data


def _problem(data) -> str | None:
    """Return what keeps `data` from being a `PhotometryFile`, or None."""
    if missing := _missing(data, PhotometryFile):
        return missing
    if not isinstance(data["views"], list):
        return "views is no list"
    for number, view in enumerate(data["views"]):
        if missing := _missing(view, ViewPhotometry):
            return f"view {number}: {missing}"
    return None


def _missing(data, kind: Any) -> str | None:
    if not isinstance(data, dict):
        return "not an object"
    names = [k for k in kind.__annotations__ if k not in data and k not in OPTIONAL]
    return f"{', '.join(names)} missing" if names else None
