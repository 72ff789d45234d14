"""Photometric parameters in files that other tools can read (docs/files.md).

`photometry.json` has exposures, gammas and tone curve; `metering.json` has the rule that explains
the exposures; `appearance.npy`, `ppisp.json` or `luminance.json` have corrections of a baseline.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import Appearance, CameraFormation, FitConfig, PhotometryConfig
from p2gs_jax.core.atomic import atomic_write, readable, write_json
from p2gs_jax.core.numerics import LN2, on_device
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.appearance import Corrections, identity
from p2gs_jax.photometry.display import mean_parameters
from p2gs_jax.photometry.formation import corner
from p2gs_jax.photometry.luminance import Luminance
from p2gs_jax.photometry.metering import METERS, Metering, Rule
from p2gs_jax.photometry.ppisp import Ppisp
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.presets import camera_formations
from p2gs_jax.types import Params, Photometry, Scene, View

VERSION = 2  # of photometry.json
AGAIN = "restore it from a copy, or run `p2gs-jax fit ... --resume` or `calibrate` again"

# The file, and its rows; docs/files.md describes each number, and where it is null or absent.
PhotometryFile = ViewPhotometry = CameraPhotometry = dict[str, Any]
FIELDS = ("version", "model", "curve", "gauge", "mean", "cameras", "views")
OF_VIEWS = (
    *("image", "camera", "exposure", "exposure_ev", "gamma", "exif_ev", "split"),
    "exposure_fitted",
)


def write_photometry(path: Path, **values: Any) -> None:
    """Write `photometry.json` atomically; `values` are its fields."""
    fields = {"version": VERSION, "cameras": [], **values}
    write_json(path, {name: fields[name] for name in FIELDS})


def read_photometry(path: Path) -> PhotometryFile:
    """Read `photometry.json`; UserError: it is broken, lacks a field, or has another version."""
    with readable(path, AGAIN):
        data = parse_json(Path(path).read_text(encoding="utf-8"))
    if problem := _problem(data):
        raise UserError(f"{path} is incomplete: {problem}.", fix=AGAIN)
    return data


def _problem(data) -> str | None:
    """Return the reason why `data` is not a `PhotometryFile`, or None."""
    if missing := _missing(data, FIELDS):
        return missing
    if data["version"] != VERSION:
        return f"its version is {data['version']}, and this program reads version {VERSION}"
    if not isinstance(data["views"], list):
        return "views is not a list"
    found = (_missing(view, OF_VIEWS) for view in data["views"])
    return next((f"view {number}: {words}" for number, words in enumerate(found) if words), None)


def _missing(data, fields: Sequence[str]) -> str | None:
    if not isinstance(data, dict):
        return "not an object"
    names = [name for name in fields if name not in data]
    return f"{', '.join(names)} missing" if names else None


def with_formation_of(cfg: PhotometryConfig, saved: PhotometryFile) -> PhotometryConfig:
    """Return options with the image formation of a file; it has no learned corrections.

    UserError: the file has no valid tone curve, or a broken camera.
    """
    curve, kinds = saved["curve"], ("vignetting", "splines")
    balanced = any(view.get("white_balance") is not None for view in saved["views"])
    try:
        spline = None if curve["spline"] is None else tuple(map(float, curve["spline"]))
        found = {"model": saved["model"], "curve": curve["name"], "spline": spline}
        cameras = [{"name": c["name"], **{k: c[k] or () for k in kinds}} for c in saved["cameras"]]
        found |= {"pivot": float(curve["pivot"]), "cameras": camera_formations(cameras)}
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"photometry.json has no valid tone curve or camera ({error}).", fix=AGAIN
        ) from error
    found["white_balance"] = "view" if balanced else None
    return dataclasses.replace(cfg, select=False, **found)


def write_fitted(
    path: Path,
    params: Params,
    scene: Scene,
    cfg: FitConfig,
    *,
    fitted: Mapping[int, float],
    unknown: Sequence[str] = (),
    solution: PhotometricSolution | None = None,
) -> None:
    """Write `photometry.json` of a finished fit.

    `fitted` has the exposures fitted to held-out views, by row; `unknown` has the names of
    photographs with unknown exposures. Standard errors and counts come from the `solution` from
    which the fit started.
    """
    p, mean = cfg.photometry, dataclasses.asdict(mean_parameters(params.photometry))
    gauge = (
        "mean log exposure over the training views is 0; radiance is relative to it"
        if params.photometry.parameterization == "log"
        else "soft: the mean exposure is pulled towards 1 (paper, eq. 10)"
    )
    if p.known is not None:
        gauge = f"known exposures ({p.known}); radiance is in their units"
    balance = mean.pop("white_balance")
    if balance is not None:
        mean["white_balance"] = np.exp(balance).tolist()
    row_of = {index: k for k, index in enumerate(scene.train_indices)}
    rows = [
        _fitted_row(params, view, row_of.get(index), solution, view.name in unknown)
        | {"exposure_fitted": fitted.get(index)}
        for index, view in enumerate(scene.views)
    ]
    write_photometry(
        path,
        model=p.model,
        curve={"name": p.curve, "pivot": p.pivot, "spline": p.spline},
        gauge=gauge,
        mean=mean,
        views=rows,
        cameras=_camera_rows(p.cameras, None if solution is None else solution.corner_errors),
    )


def _row(view: View, split: str) -> ViewPhotometry:
    """Return the row of a view with the fields that all views have; None where they are unknown."""
    row = dict.fromkeys((*OF_VIEWS, "white_balance", "white_balance_ev_error"))
    known = {"image": view.name, "camera": view.camera, "exif_ev": view.exif_ev, "split": split}
    return row | known


def _fitted_row(
    params: Params, view: View, k: int | None, solution: PhotometricSolution | None, unknown: bool
) -> ViewPhotometry:
    """Return the row of a view of a fit; `k` is its row in `Photometry`, None if held out."""
    row = _row(view, view.split)
    if k is not None:
        host: Photometry = jax.tree.map(np.asarray, params.photometry)
        e, balance = float(host.exposures[k]), host.white_balance
        row |= {"exposure": e, "exposure_ev": float(np.log2(e)), "gamma": float(host.gammas[k])}
        row["white_balance"] = None if balance is None else np.exp(balance[k]).tolist()
    if unknown:
        row["exposure_unknown"] = True
    if k is not None and solution is not None and np.isfinite(solution.exposure_errors[k]):
        row["exposure_ev_error"] = float(solution.exposure_errors_ev[k])
        row["gamma_error"] = float(solution.gamma_errors[k])
        row["exposure_ev_start"] = float(solution.exposures_ev[k])
        row["observations"] = int(solution.observations_per_view[k])
        row["white_balance_ev_error"] = _balance(solution, k)[1]
    return row


def write_solution(
    path: Path, solution: PhotometricSolution, *, views: Sequence[View], pivot: float, gauge: str
) -> None:
    """Write `photometry.json` of a bundle adjustment; unobserved views get nulls.

    `pivot` is the linear value that gammas do not change, and `gauge` describes what fixes the
    scale.
    """
    s, rows = solution, []
    solved = np.isfinite(s.exposure_errors)
    e = np.exp(s.log_exposures[solved])
    for i, view in enumerate(views):
        found = (np.exp(s.log_exposures[i]), s.exposures_ev[i], s.gammas[i])
        errors = (s.exposure_errors_ev[i], s.gamma_errors[i])
        values = [float(v) if solved[i] else None for v in (*found, *errors)]
        row = _row(view, "train")
        row["exposure"], row["exposure_ev"], row["gamma"] = values[:3]
        row["exposure_ev_error"], row["gamma_error"] = values[3:]
        row["white_balance"], row["white_balance_ev_error"] = _balance(s, i)
        rows.append(row)
    write_photometry(
        path,
        model=s.model,
        curve={
            "name": s.response.curve,
            "base": s.response.base,
            "pivot": pivot,
            "spline": s.response.spline,
        },
        gauge=gauge,
        mean={
            "exposure": float(e.mean()) if e.size else 1.0,
            "exposure_geometric": float(np.exp(np.log(e).mean())) if e.size else 1.0,
            "gamma": float(s.gammas[solved].mean() if solved.any() else s.gammas.mean()),
        },
        views=rows,
        cameras=_camera_rows(s.cameras, s.corner_errors),
    )


def _camera_rows(
    cameras: Sequence[CameraFormation], corner_errors: Float[np.ndarray, "c k"] | None
) -> list[CameraPhotometry]:
    """Return the `cameras` of the file, with standard errors of log V in the corners if known."""
    if corner_errors is None or len(corner_errors) != len(cameras):
        corner_errors = np.zeros((len(cameras), 0))
    return [
        {
            "name": camera.name,
            "vignetting": [list(row) for row in camera.vignetting] or None,
            "corner": list(corner(camera)) or None,
            "corner_ev_error": (errors / LN2).tolist() or None,
            "splines": [list(row) for row in camera.splines] or None,
        }
        for camera, errors in zip(cameras, corner_errors, strict=True)
    ]


def _balance(
    solution: PhotometricSolution, row: int
) -> tuple[list[float] | None, list[float] | None]:
    """Return the white balance of a view (factors) and its standard errors (stops), or None."""
    if solution.white_balance_level is None or not np.isfinite(solution.exposure_errors[row]):
        return None, None
    errors = solution.white_balance_errors[row] / LN2
    known = errors.tolist() if np.isfinite(errors).all() else None
    return np.exp(solution.white_balance[row]).tolist(), known


def write_metering(path: Path, metering: Metering) -> None:
    """Write `metering.json`: readings in stops, and the rule that explains the exposures."""
    rows = zip(metering.names, (metering.readings / LN2).tolist(), strict=True)
    write_json(
        path,
        {
            "sentence": metering.sentence,
            "rule": _rule_in_file(metering.rule),
            "candidates": [_rule_in_file(rule) for rule in metering.candidates],
            "white": metering.white,
            "readings": {name: dict(zip(METERS, row, strict=True)) for name, row in rows},
        },
    )


def read_metering(path: Path) -> Metering:
    """Read `metering.json`; UserError: it is missing or broken."""
    with readable(path, "write it again with `p2gs-jax eval RUN`"):
        data = parse_json(path.read_text(encoding="utf-8"))
        readings = data["readings"]
        values = [[row[name] for name in METERS] for row in readings.values()]
        table = np.array(values, np.float64).reshape(-1, len(METERS)) * LN2
        candidates = tuple(map(_rule, data["candidates"]))
        if all(rule.meter is not None for rule in candidates):
            raise ValueError("no candidate is a constant")
        white = float(data["white"])
        return Metering(_rule(data["rule"]), candidates, white, tuple(readings), table)


def _rule_in_file(rule: Rule) -> dict[str, Any]:
    data = dataclasses.asdict(rule)
    return {"offset_ev": data.pop("offset") / LN2, **data}


def _rule(data: dict) -> Rule:
    numbers = (data["offset_ev"], data["left_out_ev"])
    offset, left_out = (float("nan") if v is None else float(v) for v in numbers)
    return Rule(data["meter"], LN2 * offset, left_out)


class _Layout(NamedTuple):
    """The fields of a learned correction by their names in its JSON file."""

    cameras: dict[str, str]  # fields with a row for each camera
    views: dict[str, str]  # fields with a row for each view
    shared: tuple[str, ...] = ()  # fields common to all views, named as in the file


_LAYOUTS = {
    Ppisp: _Layout({"response": "responses", "vignetting": "vignettings"}, {"color": "colors"}),
    Luminance: _Layout(
        {},
        {"axes": "axes", "statistics": "statistics"},
        ("curve", "hidden", "hidden_bias", "out", "out_bias"),
    ),
}


def write_appearance(path: Path, learned: Corrections, views: Sequence[View]) -> None:
    """Write the corrections of all training views; `photometry.json` has their exposures."""
    appearance: Any = learned
    layout = _LAYOUTS.get(type(appearance))
    if layout is None:
        with atomic_write(path) as temporary:
            np.save(temporary, np.asarray(appearance))
        return

    def row(fields: dict[str, str], k: int) -> dict[str, Any]:
        return {key: np.asarray(getattr(appearance, name)[k]) for key, name in fields.items()}

    data: dict[str, Any] = {name: np.asarray(getattr(appearance, name)) for name in layout.shared}
    if layout.cameras:
        names = enumerate(appearance.names)
        data["cameras"] = {name: row(layout.cameras, k) for k, name in names}
    data["views"] = {
        view.name: {"camera": view.camera, **row(layout.views, k)} for k, view in enumerate(views)
    }
    write_json(path, data)


def read_appearance(path: Path, kind: Appearance, views: Sequence[View]) -> Corrections:
    """Return the corrections of the training views from `write_appearance`.

    UserError: the file cannot be read, or belongs to other views.
    """
    like: Any = identity(kind, [view.camera for view in views])
    layout = _LAYOUTS.get(type(like))
    try:
        if layout is None:
            found = np.load(path, allow_pickle=False)
            if found.shape != np.asarray(like).shape:
                raise KeyError(found.shape)
            return on_device(found)
        data = parse_json(path.read_text(encoding="utf-8"))
        of_cameras = [data["cameras"][name] for name in like.names] if layout.cameras else []
        of_views = [data["views"][view.name] for view in views]
        values = {name: data[name] for name in layout.shared}
        values |= {n: [each[key] for each in of_cameras] for key, n in layout.cameras.items()}
        values |= {n: [each[key] for each in of_views] for key, n in layout.views.items()}
        for name, rows in values.items():
            shape = getattr(like, name).shape
            values[name] = on_device(np.array(rows, np.float32).reshape(shape))
        return dataclasses.replace(like, **values)
    except (OSError, ValueError) as error:
        fix = "finish the fit again with --resume"
        raise UserError(f"{path} cannot be read: {error}.", fix=fix) from error
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} does not belong to this run.", fix="fit again") from error
