"""Sections on the photometry: model, exposures, gammas, tone curve."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.formation import inverse_tone_map
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.report import run_summary
from p2gs_jax.report.charts import (
    FITTED,
    RECOVERED,
    STATED,
    TRUE,
    ChartPanel,
    Series,
    ToneCurve,
    panels_chart,
    response_chart,
)
from p2gs_jax.report.drive_charts import CameraOverTime, over_time_chart
from p2gs_jax.report.formation_sections import (
    responses_section,
    vignetting_section,
    white_balance_section,
)
from p2gs_jax.report.page import Section, figure, folded, listed, paragraph, table
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.report.scene_measurements import SceneMeasurements, true_stops
from p2gs_jax.report.svg import FIRST, INK, SECOND
from p2gs_jax.run.photometry_files import ViewPhotometry, with_curve_of
from p2gs_jax.run.scene_file import read_times
from p2gs_jax.scene.drives.recording import (
    short_name,
)
from p2gs_jax.types import GAMMA_SRGB

# More cameras than this, or cameras with fewer views than this, share one panel.
MOST_PANELS, FEWEST_VIEWS = 6, 3
MID_GREY = 0.18
ORDER = "photograph, in the order of names"


def model_section(run: RunFiles) -> Section:
    """What varies between views, and why."""
    if run.photometry is None:
        return Section("model", "What was modelled, and why", "")
    model, curve = run.photometry["model"], run.photometry["curve"]
    what = run_summary.DESCRIPTIONS.get(model, model)
    body = paragraph(f"Model: {what}. Tone curve: {_curve_words(curve)}.")
    body += listed(run_summary.reasons(run))
    if run_summary.reasons(run):
        body += paragraph(
            "Models and curves compete on colours of shared surface points that were held out, by "
            "their log-likelihood: 0.01 per observation is little, 1 is a lot. The simplest model "
            "that predicts about as well as the best one is taken.",
            "note",
        )
    body += paragraph(f"Scale: {run.photometry['gauge']}.", "note")
    return Section("model", "What was modelled, and why", body)


def _curve_words(curve: dict) -> str:
    name = str(curve.get("name"))
    return run_summary.CURVES.get(name, name)


def exposure_section(run: RunFiles, scene: SceneMeasurements) -> Section:
    """Exposures over time for each camera, with what EXIF and the truth say."""
    views = [v for v in run.views if v["exposure"] is not None or v["exposure_fitted"] is not None]
    if not views:
        return Section("exposures", "Exposures", "")
    center = float(np.mean([v["exposure_ev"] or 0.0 for v in run.train] or [0.0]))
    panels = [_exposure_panel(title, rows, run, scene, center) for title, rows in _groups(run)]
    chart = panels_chart(
        panels,
        y_label="exposure, stops from the mean",
        x_label=ORDER,
        label="Exposures of the photographs of each camera, in stops",
        band=0.0,
    )
    body = figure(chart, " ".join(_exposure_caption(run, scene)))
    times = read_times(run.folder)
    if times:
        body = _over_time(run, times, center) + folded("Each camera by itself", body)
    body += folded("Every photograph in numbers", _exposure_table(run, scene, center))
    return Section("exposures", "Exposures", body)


def _over_time(run: RunFiles, times: dict[str, float], center: float) -> str:
    """Return exposures of a drive over its seconds, a line a camera."""
    start = min(times.values())
    cameras = []
    for name in run.cameras:
        rows = [v for v in run.views if v["camera"] == name and v["image"] in times]
        rows.sort(key=lambda v: times[v["image"]])
        if not rows:
            continue
        found = _column(v["exposure_ev"] for v in rows) - center
        with np.errstate(divide="ignore"):
            fitted = np.log2(_column(v["exposure_fitted"] for v in rows)) - center
        cameras.append(
            CameraOverTime(
                short_name(name),
                np.array([times[v["image"]] - start for v in rows]),
                found,
                2 * _column(v.get("exposure_ev_error") for v in rows),
                np.where(np.isfinite(found), np.nan, fitted),
            )
        )
    chart = over_time_chart(
        cameras,
        title="exposure, stops from the mean",
        label="Exposures of every camera over the seconds of the drive, in stops",
    )
    said = "A line a camera; error bars: two standard errors; empty marks: held-out photographs."
    return figure(chart, said)


def _groups(run: RunFiles) -> list[tuple[str, list[ViewPhotometry]]]:
    """Return the views of each camera, or of all where there are many or small ones."""
    by_camera = {c: [v for v in run.views if v["camera"] == c] for c in run.cameras}
    small = np.median([len(rows) for rows in by_camera.values()]) < FEWEST_VIEWS
    if len(by_camera) > MOST_PANELS or small:
        return [("all photographs", run.views)]
    if len(by_camera) == 1:
        return [("", run.views)]
    return [(f"camera {name}", rows) for name, rows in by_camera.items()]


def _exposure_panel(
    title: str, rows: list[ViewPhotometry], run: RunFiles, scene: SceneMeasurements, center: float
) -> ChartPanel:
    x = np.arange(1, len(rows) + 1, dtype=float)
    found = _column(v["exposure_ev"] for v in rows) - center
    with np.errstate(divide="ignore"):
        fitted = np.log2(_column(v["exposure_fitted"] for v in rows)) - center
    fitted = np.where(np.isfinite(found), np.nan, fitted)
    errors = 2 * _column(v.get("exposure_ev_error") for v in rows)
    series = [Series("found", x, found, RECOVERED, errors), Series("held out", x, fitted, FITTED)]
    offset = _exif_offset(run)
    if offset is not None:
        stated = _column(v["exif_ev"] for v in rows) + offset - center
        series.append(Series("EXIF", x, stated, STATED))
    shift = _truth_offset(run, scene)
    if shift is not None:
        true = true_stops([v["image"] for v in rows], scene.true_exposures) + shift - center
        series.append(Series("true", x, true, TRUE))
    return ChartPanel(title, tuple(s for s in series if np.isfinite(s.y).any()))


def _column(values) -> np.ndarray:
    return np.array([np.nan if v is None else v for v in values], float)


def _exif_offset(run: RunFiles) -> float | None:
    """Return what lays EXIF over the recovered exposures, stops."""
    agreement = run_summary.against_exif(run)
    return None if agreement is None else agreement.offset_ev


def _truth_offset(run: RunFiles, scene: SceneMeasurements) -> float | None:
    """Return what lays the true exposures over the recovered ones, stops."""
    found = _column(v["exposure_ev"] for v in run.train)
    true = true_stops([v["image"] for v in run.train], scene.true_exposures)
    both = np.isfinite(found) & np.isfinite(true)
    return float(np.mean((found - true)[both])) if both.any() else None


def _exposure_caption(run: RunFiles, scene: SceneMeasurements) -> list[str]:
    out = ["Filled circles: found by the fit."]
    errors = [e for v in run.train if (e := v.get("exposure_ev_error")) is not None]
    if errors and max(errors) > 0:
        out.append(
            f"Error bars: two standard errors, at most ±{2 * max(errors):.2g} stops here"
            + (", smaller than the marks." if 2 * max(errors) < 0.05 else ".")
        )
    elif not errors:
        out.append("There are no error bars: nothing was solved beforehand from shared points.")
    if any(v["split"] == "test" for v in run.views):
        out.append("Open diamonds: fitted to held-out photographs after the run.")
    agreement = run_summary.against_exif(run)
    if agreement is not None:
        out.append(
            f"Crosses, dotted: EXIF, laid over them; correlation {agreement.correlation:.2f}, RMS "
            f"{agreement.rms_ev:.2f} stops."
        )
    error = run_summary.true_error(run, scene)
    if error is not None:
        out.append(
            f"Open squares, dashed: the true exposures; RMS error {error['ev']:.3f} stops, largest "
            f"{error['ev_max']:.3f}."
        )
    return out


def _exposure_table(run: RunFiles, scene: SceneMeasurements, center: float) -> str:
    def shown(value: float, digits: str = "+.2f") -> str:
        return format(value, digits) if np.isfinite(value) else ""

    exif, true = _exif_offset(run), _truth_offset(run, scene)
    names = ["photograph", "camera", "stops", "error", "gamma"]
    names += ["EXIF"] if exif is not None else []
    names += ["true"] if true is not None else []
    rows = []
    for v in run.views:
        held_out = v["exposure"] is None and v["exposure_fitted"] is not None
        ev = _column([v["exposure_ev"]])[0]
        if held_out:
            ev = float(np.log2(v["exposure_fitted"] or np.nan))
        row = [
            v["image"],
            v["camera"],
            shown(ev - center),
            "held out" if held_out else shown(_column([v.get("exposure_ev_error")])[0], ".3f"),
            shown(_column([v["gamma"]])[0], ".2f"),
        ]
        if exif is not None:
            row.append(shown(_column([v["exif_ev"]])[0] + exif - center))
        if true is not None:
            row.append(shown(true_stops([v["image"]], scene.true_exposures)[0] + true - center))
        rows.append(row)
    return table(names, rows, numbers=range(2, len(names)), tall=True)


def gamma_section(run: RunFiles) -> Section:
    """Gammas, where there are any to show."""
    found = [v["gamma"] for v in run.train if v["gamma"] is not None]
    if not found or run.photometry is None:
        return Section("gamma", "Gamma", "")
    level = MODELS[run.photometry["model"]].gamma if run.photometry["model"] in MODELS else "view"
    if level is None or np.ptp(found) < 1e-3:
        body = paragraph(
            f"Gamma was not modelled: it is {np.mean(found):.2f} in all views. Contrast that "
            "differs between photographs is left to the radiance."
        )
        return Section("gamma", "Gamma", body)
    panels = []
    for title, rows in _groups(run):
        x = np.arange(1, len(rows) + 1, dtype=float)
        gammas = _column(v["gamma"] for v in rows)
        errors = 2 * _column(v.get("gamma_error") for v in rows)
        panels.append(ChartPanel(title, (Series("", x, gammas, RECOVERED, errors),)))
    chart = panels_chart(
        panels,
        y_label="gamma",
        x_label=ORDER,
        label="Gammas of the photographs of each camera",
        band=GAMMA_SRGB,
    )
    said = (
        "Gamma turns the tone curve about mid-grey: above the line at 2.2 a photograph has less "
        "contrast than its curve alone. Error bars: two standard errors."
    )
    return Section("gamma", "Gamma", figure(chart, said))


def response_section(run: RunFiles) -> Section:
    """The tone curve against sRGB."""
    if run.photometry is None:
        return Section("response", "Tone curve", "")
    try:
        cfg = PhotometryConfig() if run.cfg is None else run.cfg.photometry
        cfg = with_curve_of(cfg, run.photometry)
    except UserError as error:
        return Section("response", "Tone curve", paragraph(error.message))
    gammas = [v["gamma"] for v in run.train if v["gamma"] is not None] or [GAMMA_SRGB]
    y = np.linspace(0.004, 1.0, 240)
    srgb = dataclasses.replace(PhotometryConfig(), curve="srgb")
    curves = []
    low, middle, high = min(gammas), float(np.median(gammas)), max(gammas)
    if high - low > 0.02:
        curves.append(ToneCurve(f"γ {low:.2f}", _stops(y, low, cfg), y, SECOND, "-."))
        curves.append(ToneCurve(f"γ {high:.2f}", _stops(y, high, cfg), y, SECOND, ":"))
    own, standard = _stops(y, middle, cfg), _stops(y, GAMMA_SRGB, srgb)
    curves.append(ToneCurve("this run", own, y, FIRST, "-", 5.0, 0.45))
    curves.append(ToneCurve("sRGB", standard, y, INK, (0, (4, 4))))
    same = np.abs(own - standard)[y > 0.05].max()
    said = "How exposed radiance becomes a value in the photograph. "
    if same < 0.01:
        said += "The curve of this run is sRGB's."
    else:
        said += "Broad: this run; dashed: sRGB. They are at most "
        said += f"{same:.2f} stops apart at values above 0.05."
    if high - low > 0.02:
        said += " Dash-dotted and dotted: the smallest and the largest gamma of a view."
    chart = response_chart(curves, label="Tone curve of this run against sRGB")
    return Section("response", "Tone curve", figure(chart, said))


def _stops(y: np.ndarray, gamma: float, cfg: PhotometryConfig) -> np.ndarray:
    linear = np.asarray(inverse_tone_map(jnp.asarray(y), jnp.float32(gamma), cfg))
    return np.log2(np.maximum(linear, 1e-6) / MID_GREY)


def camera_sections(run: RunFiles, scene: SceneMeasurements) -> Sequence[Section]:
    """All of them."""
    return (
        model_section(run),
        exposure_section(run, scene),
        white_balance_section(run, _groups),
        gamma_section(run),
        response_section(run),
        responses_section(run),
        vignetting_section(run),
    )
