"""Sections on the photometry: model, exposures, white balance, gammas, curves, vignetting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.formation import corner, inverse_tone_map, log_vignetting
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.presets import camera_formations
from p2gs_jax.report import charts, findings
from p2gs_jax.report.charts import Series, Style
from p2gs_jax.report.findings import against_exif, column, reasons
from p2gs_jax.report.page import figure, folded, listed, paragraph, table
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.report.svg import FIRST, FOURTH, INK, MUTED, SECOND, THIRD
from p2gs_jax.run.photometry_files import CameraPhotometry, ViewPhotometry, with_curve_of
from p2gs_jax.run.scene_file import read_times
from p2gs_jax.scene.drives.recording import short_name
from p2gs_jax.types import GAMMA_SRGB

# More cameras than this, or cameras with fewer views than this, share one panel.
MOST_PANELS, FEWEST_VIEWS = 6, 3
MID_GREY = 0.18
CHANNELS = ("red", "green", "blue")
_MARKS = ((SECOND, "^", 4), (THIRD, "o", 3), (FIRST, "s", 2))
MARKED = tuple(Style(color, marker, "-", order=order) for color, marker, order in _MARKS)
PLAIN, DASHED = Style(FIRST, "", "-"), Style(INK, "", (0, (4, 4)), width=1.6)
LINES = (Style(SECOND, "", "-"), Style(THIRD, "", "--"), Style(FIRST, "", ":"))
# Lines of the cameras of a drive, in turn.
CAMERA_COLORS, CAMERA_MARKERS = (FIRST, SECOND, THIRD, FOURTH, INK, MUTED), "osD^vPX*"
COLORS, DASHES = (FIRST, SECOND, THIRD, FOURTH), ("-", "--", "-.", ":")
STOPS = "exposure, stops from the mean"
# Display values at which tone curves are drawn.
VALUES = np.linspace(0.004, 1.0, 240)


def model_section(run: RunFiles) -> str:
    """Return what varies between views, and why."""
    if run.photometry is None:
        return ""
    model, curve = run.photometry["model"], str(run.photometry["curve"].get("name"))
    what, under = findings.DESCRIPTIONS.get(model, model), findings.CURVES.get(curve, curve)
    body = paragraph(f"Model: {what}. Tone curve: {under}.")
    body += listed(reasons(run))
    if reasons(run):
        body += paragraph(
            "Models and curves compete on colours of shared surface points that were held out, by "
            "their log-likelihood: 0.01 per observation is little, 1 is a lot. The simplest model "
            "that predicts about as well as the best one is taken.",
            "note",
        )
    return body + paragraph(f"Scale: {run.photometry['gauge']}.", "note")


def _chart(
    run: RunFiles,
    curves: Callable[[list[ViewPhotometry], np.ndarray], Sequence[Series]],
    y_label: str,
    label: str,
    caption: str,
    band: float = 0.0,
) -> str:
    """Return a panel for each camera, or one for all where there are many or small ones.

    `curves` returns those of a panel from its views and their places.
    """
    by_camera = {f"camera {c}": [v for v in run.views if v["camera"] == c] for c in run.cameras}
    small = np.median([len(rows) for rows in by_camera.values()]) < FEWEST_VIEWS
    if len(by_camera) > MOST_PANELS or small:
        by_camera = {"all photographs": run.views}
    elif len(by_camera) == 1:
        by_camera = {"": run.views}
    panels = [(title, curves(v, np.arange(1.0, len(v) + 1))) for title, v in by_camera.items()]
    order = "photograph, in the order of names"
    chart = charts.panels_chart(panels, y_label=y_label, x_label=order, label=label, band=band)
    return figure(chart, caption)


def _every(names: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a folded table of all photographs; numbers follow their name and camera."""
    names = ["photograph", "camera", *names]
    numbers = table(names, rows, numbers=range(2, len(names)), tall=True)
    return folded("Every photograph in numbers", numbers)


def exposure_section(run: RunFiles, truth: dict[str, float]) -> str:
    """Return exposures over time for each camera, with what EXIF and the truth say."""
    if all(v["exposure"] is None and v["exposure_fitted"] is None for v in run.views):
        return ""
    center = float(np.mean([v["exposure_ev"] or 0.0 for v in run.train] or [0.0]))
    # What lays EXIF, and the true exposures, over the recovered ones, stops.
    agreement = against_exif(run)
    exif = None if agreement is None else agreement.offset_ev
    gap = column(v["exposure_ev"] for v in run.train) - _true_stops(run.train, truth)
    known = np.isfinite(gap)
    true = float(np.mean(gap[known])) if known.any() else None

    def stops(rows: list[ViewPhotometry]) -> dict[str, np.ndarray]:
        """Return exposures from the mean by source; NaN where unknown."""
        found = column(v["exposure_ev"] for v in rows) - center
        with np.errstate(divide="ignore"):
            fitted = np.log2(column(v["exposure_fitted"] for v in rows)) - center
        out = {"found": found, "held out": np.where(np.isfinite(found), np.nan, fitted)}
        if exif is not None:
            out["EXIF"] = column(v["exif_ev"] for v in rows) + exif - center
        if true is not None:
            out["true"] = _true_stops(rows, truth) + true - center
        return out

    def curves(rows: list[ViewPhotometry], x: np.ndarray) -> list[Series]:
        errors = {"found": 2 * _errors(rows)}
        every = [Series(n, x, y, charts.SOURCES[n], errors.get(n)) for n, y in stops(rows).items()]
        return [s for s in every if np.isfinite(s.y).any()]

    label = "Exposures of the photographs of each camera, in stops"
    body = _chart(run, curves, STOPS, label, " ".join(_exposure_caption(run, truth)))
    times = read_times(run.folder)
    if times:
        body = _over_time(run, times, stops) + folded("Each camera by itself", body)
    more, rows = [name for name in stops([]) if name in ("EXIF", "true")], []
    for v, *values in zip(run.views, *stops(run.views).values(), strict=True):
        found, fitted, *others = values
        held_out = np.isfinite(fitted) and v["exposure"] is None
        error = "held out" if held_out else _shown(v.get("exposure_ev_error"), ".3f")
        ev = _shown(fitted if held_out else found, "+.2f")
        stated = [_shown(value, "+.2f") for value in others]
        rows.append([v["image"], v["camera"], ev, error, _shown(v["gamma"], ".2f"), *stated])
    return body + _every(["stops", "error", "gamma", *more], rows)


def _shown(value: float | None, form: str) -> str:
    return format(value, form) if value is not None and np.isfinite(value) else ""


def _errors(rows: list[ViewPhotometry]) -> np.ndarray:
    return column(v.get("exposure_ev_error") for v in rows)


def _true_stops(rows: list[ViewPhotometry], truth: dict[str, float]) -> np.ndarray:
    """Return true exposures in stops, NaN where unknown."""
    known = (truth.get(v["image"], 0.0) for v in rows)
    return np.array([np.log2(e) if e > 0 else np.nan for e in known])


def _over_time(
    run: RunFiles,
    times: dict[str, float],
    stops: Callable[[list[ViewPhotometry]], dict[str, np.ndarray]],
) -> str:
    """Return exposures of a drive over its seconds, a line a camera."""
    start = min(times.values())
    series = []
    for k, name in enumerate(run.cameras):
        rows = [v for v in run.views if v["camera"] == name and v["image"] in times]
        rows.sort(key=lambda v: times[v["image"]])
        seconds, found = np.array([times[v["image"]] - start for v in rows]), stops(rows)
        turn, color = divmod(k, len(CAMERA_COLORS))
        line, marker = ("-", (0, (5, 2)))[turn % 2], CAMERA_MARKERS[k % len(CAMERA_MARKERS)]
        style = Style(CAMERA_COLORS[color], marker, line, size=4, width=1.2)
        empty = replace(style, line="", filled=False, size=5)
        known = np.isfinite(found["found"])
        y, errors = found["found"][known], 2 * _errors(rows)[known]
        series.append(Series(short_name(name), seconds[known], y, style, errors))
        series.append(Series("", seconds, found["held out"], empty))
    label = "Exposures of every camera over the seconds of the drive, in stops"
    caption = "A line a camera; error bars: two standard errors; empty marks: held-out photographs."
    panels = [("", series)]
    chart = charts.panels_chart(panels, y_label=STOPS, x_label="seconds", label=label, band=0.0)
    return figure(chart, caption)


def _exposure_caption(run: RunFiles, truth: dict[str, float]) -> list[str]:
    out = ["Filled circles: found by the fit."]
    errors = [e for v in run.train if (e := v.get("exposure_ev_error")) is not None]
    if errors and max(errors) > 0:
        small = ", smaller than the marks." if 2 * max(errors) < 0.05 else "."
        out.append(
            f"Error bars: two standard errors, at most ±{2 * max(errors):.2g} stops here{small}"
        )
    elif not errors:
        out.append("There are no error bars: nothing was solved beforehand from shared points.")
    if any(v["split"] == "test" for v in run.views):
        out.append("Open diamonds: fitted to held-out photographs after the run.")
    agreement, error = against_exif(run), findings.true_error(run, truth)
    if agreement is not None:
        out.append(
            f"Crosses, dotted: EXIF, laid over them; correlation {agreement.correlation:.2f}, RMS "
            f"{agreement.rms_ev:.2f} stops."
        )
    if error is not None:
        out.append(
            f"Open squares, dashed: the true exposures; RMS error {error['ev']:.3f} stops, largest "
            f"{error['ev_max']:.3f}."
        )
    return out


def white_balance_section(run: RunFiles) -> str:
    """Return the white balance of every view, in stops."""
    views = [v for v in run.views if v.get("white_balance") is not None]
    if not views:
        return ""

    def stops(rows: list[ViewPhotometry]) -> np.ndarray:
        return np.log2(_triples(v.get("white_balance") for v in rows))

    def curves(rows: list[ViewPhotometry], x: np.ndarray) -> list[Series]:
        y, errors = stops(rows), 2 * _triples(v.get("white_balance_ev_error") for v in rows)
        names = enumerate(CHANNELS)
        return [Series(name, x, y[:, c], MARKED[c], errors[:, c]) for c, name in names]

    most = views[int(np.argmax(np.ptp(stops(views), axis=1)))]
    body = _chart(
        run,
        curves,
        "gain beside the exposure, stops",
        "White balance of the photographs of each camera, in stops",
        "Gains of the channels beside the exposure. In every photograph they average to 0, and so "
        "does each channel over the photographs: only differences can be known. Error bars: two "
        f"standard errors. Furthest from neutral: {most['image']}.",
    )
    cells = []
    for v, gains in zip(views, stops(views), strict=True):
        errors = v.get("white_balance_ev_error")
        known = ["" if errors is None else f" ± {e:.3f}" for e in errors or CHANNELS]
        each = [f"{gain:+.3f}{error}" for gain, error in zip(gains, known, strict=True)]
        cells.append([v["image"], v["camera"], *each])
    return body + _every([f"{name}, stops" for name in CHANNELS], cells)


def _triples(values) -> np.ndarray:
    return np.array([[np.nan] * 3 if v is None else v for v in values], float).reshape(-1, 3)


def gamma_section(run: RunFiles) -> str:
    """Return gammas, where there are any to show."""
    found = [v["gamma"] for v in run.train if v["gamma"] is not None]
    if not found or run.photometry is None:
        return ""
    level = MODELS[run.photometry["model"]].gamma if run.photometry["model"] in MODELS else "view"
    if level is None or np.ptp(found) < 1e-3:
        return paragraph(
            f"Gamma was not modelled: it is {np.mean(found):.2f} in all views. Contrast that "
            "differs between photographs is left to the radiance."
        )

    def curves(rows: list[ViewPhotometry], x: np.ndarray) -> list[Series]:
        errors = 2 * column(v.get("gamma_error") for v in rows)
        return [Series("", x, column(v["gamma"] for v in rows), charts.FOUND, errors)]

    caption = (
        "Gamma turns the tone curve about mid-grey: above the line at 2.2 a photograph has less "
        "contrast than its curve alone. Error bars: two standard errors."
    )
    label = "Gammas of the photographs of each camera"
    return _chart(run, curves, "gamma", label, caption, GAMMA_SRGB)


def _stops(
    y: np.ndarray, cfg: PhotometryConfig, gamma: float = GAMMA_SRGB, camera: int | None = None
) -> np.ndarray:
    """Return the exposed radiance of display values, in stops from mid-grey."""
    linear = inverse_tone_map(y.astype(np.float32), np.float32(gamma), cfg, camera)
    return np.log2(np.maximum(np.asarray(linear), 1e-6) / MID_GREY)


def response_section(run: RunFiles) -> str:
    """Return the tone curve against sRGB."""
    if run.photometry is None:
        return ""
    try:
        cfg = PhotometryConfig() if run.cfg is None else run.cfg.photometry
        cfg = with_curve_of(cfg, run.photometry)
    except UserError as error:
        return paragraph(error.message)
    gammas = [v["gamma"] for v in run.train if v["gamma"] is not None] or [GAMMA_SRGB]
    low, middle, high = min(gammas), float(np.median(gammas)), max(gammas)
    differ, curves = high - low > 0.02, []
    for gamma, line in ((low, "-."), (high, ":")) if differ else ():
        style = Style(SECOND, "", line, width=1.6)
        curves.append(Series(f"γ {gamma:.2f}", _stops(VALUES, cfg, gamma), VALUES, style))
    own = _stops(VALUES, cfg, middle)
    standard = _stops(VALUES, replace(PhotometryConfig(), curve="srgb"))
    broad = Style(FIRST, "", "-", width=5.0, opacity=0.45)
    curves.append(Series("this run", own, VALUES, broad))
    curves.append(Series("sRGB", standard, VALUES, DASHED))
    apart = np.abs(own - standard)[VALUES > 0.05].max()
    far = f"They are at most {apart:.2f} stops apart at values above 0.05."
    caption = "How exposed radiance becomes a value in the photograph. "
    same = "The curve of this run is sRGB's."
    caption += same if apart < 0.01 else f"Broad: this run; dashed: sRGB. {far}"
    if differ:
        caption += " Dash-dotted and dotted: the smallest and the largest gamma of a view."
    chart = charts.response_chart(curves, label="Tone curve of this run against sRGB")
    return figure(chart, caption)


def _cameras(run: RunFiles) -> list[CameraPhotometry]:
    return [] if run.photometry is None else run.photometry.get("cameras", [])


def responses_section(run: RunFiles) -> str:
    """Return the curves of cameras and channels that have their own; empty where none has."""
    curved = [c for c in _cameras(run) if c["splines"]]
    if not curved or run.photometry is None:
        return ""
    formations = camera_formations(
        [{"name": c["name"], "vignetting": (), "splines": c["splines"]} for c in curved]
    )
    # With one response per channel for all cameras, the first stands for all.
    if all(c.splines == formations[0].splines for c in formations):
        formations = formations[:1]
    pivot = float(run.photometry["curve"].get("pivot") or MID_GREY)
    cfg = PhotometryConfig(curve="spline", cameras=formations, pivot=pivot)
    curves = []
    for k, camera in enumerate(formations):
        stops = _stops(np.repeat(VALUES[:, None], 3, 1), cfg, camera=k)
        several = len(camera.splines) > 1
        for c in range(len(camera.splines)):
            named = [camera.name] * (len(formations) > 1) + [CHANNELS[c]] * several
            label = " ".join(named) if len(formations) <= MOST_PANELS else ""
            color, line = (c, k) if several else (k, c)
            style = Style(COLORS[color % len(COLORS)], "", DASHES[line % len(DASHES)], width=1.6)
            curves.append(Series(label, stops[:, c], VALUES, style))
    srgb = _stops(VALUES, PhotometryConfig())
    curves.append(Series("sRGB", srgb, VALUES, DASHED))
    what = "cameras" if len(formations) > 1 else "channels"
    chart = charts.response_chart(curves, label=f"Responses of the {what} against sRGB")
    apart = np.ptp([c.x for c in curves[:-1]], axis=0)[VALUES > 0.05].max()
    caption = (
        f"Each of the {what} has a response of its own; at values above 0.05 they are at most "
        f"{apart:.2f} stops apart. Dashed in ink: sRGB."
    )
    return figure(chart, caption)


def vignetting_section(run: RunFiles) -> str:
    """Return how cameras darken towards their corners; empty where it is not modelled."""
    shaded = [c for c in _cameras(run) if c["vignetting"]]
    if not shaded:
        return ""
    formations = camera_formations(
        [{"name": c["name"], "vignetting": c["vignetting"], "splines": ()} for c in shaded]
    )
    cfg = PhotometryConfig(cameras=formations)
    r = np.linspace(0, 1, 51)
    light = [100 * np.exp(log_vignetting(r**2, k, cfg)) for k in range(len(formations))]
    panels: list[tuple[str, Sequence[Series]]] = []
    if len(formations) > MOST_PANELS:
        every = [Series("", 100 * r, y, PLAIN) for v in light for y in v.T]
        panels.append((f"{len(formations)} cameras", every))
    for c, v in zip(formations, light, strict=True) if not panels else ():
        named = zip(CHANNELS, v.T, LINES, strict=True)
        lines = named if len(c.vignetting) > 1 else [("", v[:, 0], PLAIN)]
        series = [Series(name, 100 * r, y, line) for name, y, line in lines]
        panels.append((f"camera {c.name}" if len(formations) > 1 else "", series))
    chart = charts.panels_chart(
        panels,
        y_label="light that is left, %",
        x_label="distance from the centre, % of the way to the corners",
        label="Vignetting of each camera",
        band=100.0,
    )
    cells = []
    for camera, found in zip(formations, shaded, strict=True):
        errors = found["corner_ev_error"] or []
        for k, left in enumerate(corner(camera)):
            known = f" ± {errors[k]:.2f}" if k < len(errors) else ""
            which = CHANNELS[k] if len(camera.vignetting) > 1 else "all"
            ev = f"{np.log2(left):+.2f}{known}"
            cells.append([camera.name, which, f"{100 * (1 - left):.0f} %", ev])
    body = figure(
        chart,
        "What the lens leaves of the light, by distance from the image's centre. It is divided out "
        "of what the photographs say of the radiance.",
    )
    names = ["camera", "channels", "lost in the corners", "that is, stops"]
    return body + table(names, cells, numbers=range(2, 4))
