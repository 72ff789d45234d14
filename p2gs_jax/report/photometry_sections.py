"""Sections on the photometry: model, exposures, white balance, gammas, curves, vignetting."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.text import natural
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.alignment import error_of_views
from p2gs_jax.photometry.formation import inverse_tone_map
from p2gs_jax.presets import camera_formations
from p2gs_jax.report import findings
from p2gs_jax.report.charts import COLORS, DASHES, FIRST, INK, MUTED, SOURCES, Series, panels_chart
from p2gs_jax.report.findings import against_exif, cell, column, notes_of
from p2gs_jax.report.page import figure, folded, listed, paragraph, table
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.run.photometry_files import CameraPhotometry, ViewPhotometry, with_formation_of
from p2gs_jax.run.plots import CHANNELS, MARKERS
from p2gs_jax.run.scene_file import read_times
from p2gs_jax.scene.drives.recording import short_name
from p2gs_jax.types import GAMMA_SRGB

# More cameras than the first, or cameras with fewer views than the second, share one panel.
MOST_PANELS, FEWEST_VIEWS = 6, 3
MID_GREY = 0.18
CHANNEL_COLORS = (1, 2, 0)  # indices in `COLORS`
MARKED = [{"color": COLORS[k], "marker": m} for k, m in zip(CHANNEL_COLORS, "^os", strict=True)]
SRGB: dict[str, Any] = {"color": INK, "linestyle": (0, (4, 4))}
# Colours of the cameras of a drive, in turn.
CAMERA_COLORS = (*COLORS, INK, MUTED)
STOPS = "exposure, stops from the mean"
# Display values at which tone curves are drawn.
VALUES = np.linspace(0.02, 1.0, 240)


def model_section(run: RunFiles) -> str:
    """Return the photometric model and the reasons for it."""
    if run.photometry is None:
        return listed(notes_of(run))
    model, curve = run.photometry["model"], str(run.photometry["curve"].get("name"))
    kind, tone_curve = findings.DESCRIPTIONS.get(model, model), findings.CURVES.get(curve, curve)
    return (
        paragraph(f"Model: {kind}. Tone curve: {tone_curve}. Scale: {run.photometry['gauge']}.")
        + paragraph(
            "Models and curves are scored by their errors on held-out colours of surface points. "
            "The fit keeps the simplest one that is about as good as the best. Its notes:",
            "note",
        )
        + listed(notes_of(run))
    )


def _chart(
    run: RunFiles,
    curves: Callable[[list[ViewPhotometry], np.ndarray], Sequence[Series]],
    y_label: str,
    label: str,
    caption: str,
) -> str:
    """Return a panel for each camera, or one for all cameras if they are many or have few views.

    `curves` returns the curves of a panel from its views and their positions on the x axis.
    """
    views = sorted(run.views, key=lambda v: natural(v["image"]))
    by_camera = {f"camera {c}": [v for v in views if v["camera"] == c] for c in run.cameras}
    small = np.median([len(rows) for rows in by_camera.values()]) < FEWEST_VIEWS
    if len(by_camera) > MOST_PANELS or small:
        by_camera = {"all photographs": views}
    elif len(by_camera) == 1:
        by_camera = {"": views}
    panels = [(title, curves(v, np.arange(1.0, len(v) + 1))) for title, v in by_camera.items()]
    order = "photographs in the order of their names"
    chart = panels_chart(panels, y_label=y_label, x_label=order, label=label, level=0.0)
    return figure(chart, caption)


# Exposures of views relative to the mean, stops, by source; NaN if unknown.
Stops = Callable[[list[ViewPhotometry]], dict[str, np.ndarray]]


def exposure_section(run: RunFiles, truth: dict[str, float]) -> str:
    """Return charts and a table of recovered, held-out, EXIF and true exposures."""
    if all(v["exposure"] is None and v["exposure_fitted"] is None for v in run.views):
        return ""
    stops = _stops_by_source(run, truth)

    def curves(rows: list[ViewPhotometry], x: np.ndarray) -> list[Series]:
        errors = {"recovered": 2 * _errors(rows)}
        return [
            Series(name, x, y, SOURCES[name], errors.get(name))
            for name, y in stops(rows).items()
            if np.isfinite(y).any()
        ]

    label = "Exposures of the photographs of each camera, in stops"
    body = _chart(run, curves, STOPS, label, " ".join(_exposure_caption(run, truth)))
    times = read_times(run.folder)
    if times:
        body = _over_time(run, times, stops) + folded("One panel per camera", body)
    more, rows = [name for name in stops([]) if name in ("EXIF", "true")], []
    for v, found, fitted, *others in zip(run.views, *stops(run.views).values(), strict=True):
        held_out = np.isfinite(fitted)
        error = "held out" if held_out else cell(v.get("exposure_ev_error"), ".3f")
        ev = cell(fitted if held_out else found, "+.2f")
        stated = [cell(value, "+.2f") for value in others]
        rows.append([v["image"], v["camera"], ev, error, cell(v["gamma"], ".2f"), *stated])
    names = ["photograph", "camera", "exposure, stops", "standard error, stops", "gamma", *more]
    numbers = table(names, rows, numbers=range(2, len(names)), tall=True)
    return body + folded("Every photograph in numbers", numbers)


def _stops_by_source(run: RunFiles, truth: dict[str, float]) -> Stops:
    """Return the function of exposures; EXIF and true ones are shifted to the solved mean."""
    found = column(v["exposure_ev"] for v in run.train)
    center = float(np.mean(found[np.isfinite(found)])) if np.isfinite(found).any() else 0.0
    agreement, gap = against_exif(run), found - _true_stops(run.train, truth)
    known = np.isfinite(gap)

    def stops(rows: list[ViewPhotometry]) -> dict[str, np.ndarray]:
        found = column(v["exposure_ev"] for v in rows) - center
        with np.errstate(divide="ignore"):
            fitted = np.log2(column(v["exposure_fitted"] for v in rows)) - center
        out = {"recovered": found, "held-out view": np.where(np.isfinite(found), np.nan, fitted)}
        if agreement is not None:
            out["EXIF"] = column(v["exif_ev"] for v in rows) + agreement.offset_ev - center
        if known.any():
            out["true"] = _true_stops(rows, truth) + float(np.mean(gap[known])) - center
        return out

    return stops


def _errors(rows: list[ViewPhotometry]) -> np.ndarray:
    return column(v.get("exposure_ev_error") for v in rows)


def _true_stops(rows: list[ViewPhotometry], truth: dict[str, float]) -> np.ndarray:
    """Return the logarithms of true exposures, stops; NaN if unknown."""
    known = (truth.get(v["image"], 0.0) for v in rows)
    return np.array([np.log2(e) if e > 0 else np.nan for e in known])


def _over_time(run: RunFiles, times: dict[str, float], stops: Stops) -> str:
    """Return the exposures of a drive over its seconds, with one line per camera."""
    start, series = min(times.values()), []
    styles = zip(cycle(CAMERA_COLORS), cycle(MARKERS), strict=False)
    for name, (color, marker) in zip(run.cameras, styles, strict=False):
        rows = [v for v in run.views if v["camera"] == name and v["image"] in times]
        rows.sort(key=lambda v: times[v["image"]])
        seconds, found = np.array([times[v["image"]] - start for v in rows]), stops(rows)
        style, known = {"color": color, "marker": marker}, np.isfinite(found["recovered"])
        y, errors = found["recovered"][known], 2 * _errors(rows)[known]
        series.append(Series(short_name(name), seconds[known], y, style, errors))
        empty = SOURCES["held-out view"] | style
        series.append(Series("", seconds, found["held-out view"], empty))
    label = "Exposures of every camera over the seconds of the drive, in stops"
    caption = "Error bars are two standard errors. Empty markers are held-out views."
    chart = panels_chart(
        [("", series)], y_label=STOPS, x_label="time, seconds", label=label, level=0.0, height=260
    )
    return figure(chart, caption)


def _exposure_caption(run: RunFiles, truth: dict[str, float]) -> list[str]:
    out = ["Filled circles are exposures recovered by the fit."]
    errors = [e for v in run.train if (e := v.get("exposure_ev_error")) is not None]
    if errors:
        out.append(f"Error bars are two standard errors, at most ±{2 * max(errors):.2g} stops.")
    else:
        out.append("Error bars are missing because no exposures were solved from shared points.")
    if any(v["split"] == "test" for v in run.views):
        out.append("Open diamonds are exposures fitted to held-out photographs after the run.")
    agreement, error = against_exif(run), error_of_views(run.train, truth)
    if agreement is not None:
        out.append(f"Crosses are EXIF, shifted to one mean (RMS {agreement.rms_ev:.2f} stops).")
    if error is not None:
        out.append(f"Pluses are the true exposures (RMS error {error['ev']:.3f} stops).")
    return out


def white_balance_section(run: RunFiles) -> str:
    """Return the white balance of every view, in stops."""
    if all(v.get("white_balance") is None for v in run.views):
        return ""

    def curves(rows: list[ViewPhotometry], x: np.ndarray) -> list[Series]:
        y = np.log2(_triples(v.get("white_balance") for v in rows))
        errors = 2 * _triples(v.get("white_balance_ev_error") for v in rows)
        styles = enumerate(zip(CHANNELS, MARKED, strict=True))
        return [Series(name, x, y[:, c], style, errors[:, c]) for c, (name, style) in styles]

    return _chart(
        run,
        curves,
        "gain of the channel, stops",
        "White balance of the photographs of each camera, in stops",
        "Gains are relative to the exposure. Only their differences can be measured, so their mean "
        "is 0 over each photograph and over each channel. Error bars are two standard errors.",
    )


def _triples(values: Iterable) -> np.ndarray:
    return np.array([[np.nan] * 3 if v is None else v for v in values], float).reshape(-1, 3)


def response_section(run: RunFiles) -> str:
    """Return a chart of the tone curve, or of the curves of cameras and channels, and of sRGB."""
    if run.photometry is None:
        return ""
    try:
        curved = [c for c in run.photometry["cameras"] if c["splines"]]
        curves, caption = _camera_curves(run, curved) if curved else _curves(run)
    except UserError as error:
        return paragraph(error.message)
    srgb = _exposed(VALUES, PhotometryConfig(curve="srgb"))
    inner = VALUES > 0.05
    apart = max(float(np.abs(c.x - srgb)[inner].max()) for c in curves)
    chart = panels_chart(
        [("", [*curves, Series("sRGB", srgb, VALUES, SRGB)])],
        y_label="value in the photograph (1 is white)",
        x_label="exposed radiance, stops from mid-grey",
        label="Tone curves of this run against sRGB",
        height=260,
    )
    far = f"For values above 0.05 curves differ from sRGB (dashed) by at most {apart:.2f} stops."
    return figure(chart, f"The tone curve maps radiance times exposure to a value. {caption} {far}")


def _curves(run: RunFiles) -> tuple[list[Series], str]:
    """Return the common curve at the smallest, median and largest gamma, and a caption."""
    assert run.photometry is not None
    cfg = PhotometryConfig() if run.cfg is None else run.cfg.photometry
    cfg = with_formation_of(cfg, run.photometry)
    gammas = [v["gamma"] for v in run.train if v["gamma"] is not None] or [GAMMA_SRGB]
    ends = [(min(gammas), "-."), (max(gammas), ":")] if np.ptp(gammas) > 0.02 else []
    curves = [
        Series(f"gamma {g:.2f}", _exposed(VALUES, cfg, g), VALUES, {"color": COLORS[1], "ls": line})
        for g, line in ends
    ]
    style = {"color": FIRST, "linewidth": 5, "alpha": 0.45}
    middle = _exposed(VALUES, cfg, float(np.median(gammas)))
    curves.append(Series("this run", middle, VALUES, style))
    return curves, "Thin curves have the smallest and the largest gamma of a view." if ends else ""


def _camera_curves(run: RunFiles, curved: list[CameraPhotometry]) -> tuple[list[Series], str]:
    """Return the curves of single cameras or channels, and a caption."""
    assert run.photometry is not None
    formations = camera_formations(
        [{"name": c["name"], "vignetting": (), "splines": c["splines"]} for c in curved]
    )
    # If all cameras share their responses, one camera stands for all.
    if all(c.splines == formations[0].splines for c in formations):
        formations = formations[:1]
    pivot = float(run.photometry["curve"].get("pivot") or MID_GREY)
    cfg = PhotometryConfig(curve="spline", cameras=formations, pivot=pivot)
    curves = []
    for k, camera in enumerate(formations):
        stops = _exposed(np.repeat(VALUES[:, None], 3, 1), cfg, camera=k)
        several = len(camera.splines) > 1
        for c in range(len(camera.splines)):
            named = [camera.name] * (len(formations) > 1) + [CHANNELS[c]] * several
            name = " ".join(named) if len(formations) <= MOST_PANELS else ""
            color, line = (CHANNEL_COLORS[c], k) if several else (k, 0)
            style = {"color": COLORS[color % len(COLORS)], "linestyle": DASHES[line % len(DASHES)]}
            curves.append(Series(name, stops[:, c], VALUES, style))
    owner = "camera" if len(formations) > 1 else "channel"
    return curves, f"Each {owner} has a separate curve."


def _exposed(
    y: np.ndarray, cfg: PhotometryConfig, gamma: float = GAMMA_SRGB, camera: int | None = None
) -> np.ndarray:
    """Return the exposed radiance of display values, in stops from mid-grey."""
    linear = inverse_tone_map(y.astype(np.float32), np.float32(gamma), cfg, camera)
    return np.log2(np.maximum(np.asarray(linear), 1e-6) / MID_GREY)


def vignetting_section(run: RunFiles) -> str:
    """Return the loss of light in the corners by camera, or "" if it is not modelled."""
    cells = []
    for camera in [] if run.photometry is None else run.photometry["cameras"]:
        corners, errors = camera["corner"] or [], camera["corner_ev_error"] or []
        for k, share in enumerate(corners):
            known = f" ± {errors[k]:.2f}" if k < len(errors) else ""
            which = CHANNELS[k] if len(corners) > 1 else "all"
            stops = f"{np.log2(share):+.2f}{known}"
            cells.append([camera["name"], which, f"{100 * (1 - share):.0f} %", stops])
    if not cells:
        return ""
    names = ["camera", "channels", "loss in the corners", "brightness in the corners, stops"]
    return paragraph(
        "Lenses lose light towards the corners of a photograph. The fit models this loss, so the "
        "radiance of the splats does not contain it."
    ) + table(names, cells, numbers=range(2, 4))
