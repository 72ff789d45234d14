"""`photometry.json`: what each camera did to the light, for other tools to read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import CameraFormation
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.json_text import parse_json
from p2gs_jax.core.numerics import LN2
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.formation import corner
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.types import View

MEAN_GAUGE = "mean log exposure is 0 over each connected group of views"
# 2 knows white balance and cameras; files of before have no version.
VERSION = 2
# Absent from files of runs without a bundle adjustment, or of before version 2.
OPTIONAL = frozenset(
    {
        *("exposure_ev_error", "gamma_error", "exposure_ev_start", "observations"),
        "exposure_unknown",
        *("version", "cameras", "white_balance", "white_balance_ev_error"),
    }
)


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
        exposure_unknown: true where the photograph is black or saturated everywhere.
        exposure_ev_error: standard error of `exposure_ev` from the bundle adjustment, or null.
        gamma_error: standard error of `gamma`, or null.
        exposure_ev_start: `exposure_ev` before the first step, where a bundle adjustment gave it.
        observations: usable observations of shared points that it had in this view.
        white_balance: factors on red, green and blue beside the exposure, of geometric mean 1; null
            where it is not modelled, and of a held-out view.
        white_balance_ev_error: standard errors of their log2 from the bundle adjustment, or null.
    """

    image: str
    camera: str
    exposure: float | None
    exposure_ev: float | None
    gamma: float | None
    exif_ev: float | None
    split: str
    exposure_fitted: float | None
    exposure_unknown: NotRequired[bool]
    exposure_ev_error: NotRequired[float | None]
    gamma_error: NotRequired[float | None]
    exposure_ev_start: NotRequired[float | None]
    observations: NotRequired[int | None]
    white_balance: NotRequired[list[float] | None]
    white_balance_ev_error: NotRequired[list[float] | None]


class CameraPhotometry(TypedDict):
    """What one physical camera does besides; rows are one for all channels, or one for each.

    Attributes:
        name: as `camera` of its views.
        vignetting: rows of k1, k2, k3 in log V(r) = k1 r^2 + k2 r^4 + k3 r^6, with r = 1 in the
            corners; null: none.
        corner: V in the corners, of every row, or null.
        corner_ev_error: standard errors of their log2 from the bundle adjustment, or null.
        splines: rows of a response of its own, as `curve.spline`; null: that one.
    """

    name: str
    vignetting: list[list[float]] | None
    corner: list[float] | None
    corner_ev_error: list[float] | None
    splines: list[list[float]] | None


class PhotometryFile(TypedDict):
    """The file: model, tone curve, gauge, mean parameters, cameras, views."""

    version: NotRequired[int]
    model: str
    curve: dict
    gauge: str
    mean: dict
    cameras: NotRequired[list[CameraPhotometry]]
    views: list[ViewPhotometry]


def write_photometry(
    path: Path,
    *,
    model: str,
    curve: dict,
    gauge: str,
    mean: dict,
    views: list[ViewPhotometry],
    cameras: Sequence[CameraPhotometry] = (),
) -> None:
    """Write the file atomically.

    Raises:
        ValueError: a view lacks a field.
    """
    data = {
        "version": VERSION,
        "model": model,
        "curve": curve,
        "gauge": gauge,
        "mean": mean,
        "cameras": list(cameras),
        "views": views,
    }
    if problem := _problem(data):
        raise ValueError(problem)
    write_json(path, data)


def camera_rows(
    cameras: Sequence[CameraFormation], corner_errors: Float[np.ndarray, "c k"] | None = None
) -> list[CameraPhotometry]:
    """Return the `cameras` of the file.

    Args:
        cameras: what each does.
        corner_errors: standard errors of log V in the corners, where a bundle adjustment gave them.
    """
    known = corner_errors is not None and len(corner_errors) == len(cameras)
    return [
        {
            "name": camera.name,
            "vignetting": [list(row) for row in camera.vignetting] or None,
            "corner": list(corner(camera)) or None,
            "corner_ev_error": (corner_errors[i] / LN2).tolist() or None
            if known and corner_errors is not None
            else None,
            "splines": [list(row) for row in camera.splines] or None,
        }
        for i, camera in enumerate(cameras)
    ]


def balance_of(
    solution: PhotometricSolution, row: int
) -> tuple[list[float] | None, list[float] | None]:
    """Return white balance and its errors of a view as the file has them: factors, and stops."""
    if solution.white_balance_level is None or not np.isfinite(solution.exposure_errors[row]):
        return None, None
    errors = solution.white_balance_errors[row] / LN2
    known = errors.tolist() if np.isfinite(errors).all() else None
    return np.exp(solution.white_balance[row]).tolist(), known


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
        balance, balance_error = balance_of(s, i)
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
                "white_balance": balance,
                "white_balance_ev_error": balance_error,
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
        cameras=camera_rows(s.cameras, s.corner_errors),
    )


AGAIN = "restore it from a copy, or run `p2gs-jax fit ... --resume` or `calibrate` again"


def read_photometry(path: Path) -> PhotometryFile:
    """Read the file.

    Raises:
        UserError: it is no such file.
    """
    try:
        data = parse_json(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}.", fix=AGAIN) from error
    if problem := _problem(data):
        raise UserError(f"{path} is incomplete: {problem}.", fix=AGAIN)
    return data


def _problem(data) -> str | None:
    """Return what keeps `data` from being a `PhotometryFile`, or None."""
    if missing := _missing(data, PhotometryFile):
        return missing
    if data.get("version", 1) not in range(1, VERSION + 1):
        return f"its version is {data['version']}, and this program knows {VERSION}"
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
