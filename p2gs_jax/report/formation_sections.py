"""Sections on white balance, vignetting and responses of cameras; empty where not modelled."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from p2gs_jax.config import PhotometryConfig, camera_formations
from p2gs_jax.photometry.cameras import corner
from p2gs_jax.photometry.formation import inverse_tone_map, log_vignetting
from p2gs_jax.report.charts import (
    ChartPanel,
    Series,
    Style,
    ToneCurve,
    panels_chart,
    response_chart,
)
from p2gs_jax.report.page import Section, figure, folded, table
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.report.svg import FIRST, FOURTH, INK, SECOND, THIRD
from p2gs_jax.run.photometry_files import CameraPhotometry, ViewPhotometry
from p2gs_jax.types import GAMMA_SRGB

# More cameras than this share one panel, without names.
MOST_PANELS = 6
MID_GREY = 0.18
CHANNELS = ("red", "green", "blue")
MARKED = (
    Style(SECOND, "^", "-", order=4),
    Style(THIRD, "o", "-", order=3),
    Style(FIRST, "s", "-", order=2),
)
PLAIN = Style(FIRST, "", "-")
LINES = (Style(SECOND, "", "-"), Style(THIRD, "", "--"), Style(FIRST, "", ":"))
COLORS, DASHES = (FIRST, SECOND, THIRD, FOURTH), ("-", "--", "-.", ":")

Groups = Callable[[RunFiles], list[tuple[str, list[ViewPhotometry]]]]


def _cameras(run: RunFiles) -> list[CameraPhotometry]:
    return [] if run.photometry is None else run.photometry.get("cameras", [])


def white_balance_section(run: RunFiles, groups: Groups) -> Section:
    """White balance of every view, in stops.

    Args:
        run: the run.
        groups: views by panel.
    """
    rows = [v for v in run.views if v.get("white_balance") is not None]
    if not rows:
        return Section("white-balance", "White balance", "")
    panels = []
    for title, views in groups(run):
        x = np.arange(1, len(views) + 1, dtype=float)
        stops = np.log2(_triples(v.get("white_balance") for v in views))
        errors = 2 * _triples(v.get("white_balance_ev_error") for v in views)
        series = [
            Series(name, x, stops[:, c], MARKED[c], errors[:, c]) for c, name in enumerate(CHANNELS)
        ]
        panels.append(ChartPanel(title, tuple(series)))
    chart = panels_chart(
        panels,
        y_label="gain beside the exposure, stops",
        x_label="photograph, in the order of names",
        label="White balance of the photographs of each camera, in stops",
        band=0.0,
    )
    most = max(rows, key=lambda v: float(np.ptp(np.log2(v.get("white_balance") or [1.0]))))
    said = (
        "Gains of the channels beside the exposure. In every photograph they average to 0, and so "
        "does each channel over the photographs: only differences can be known. Error bars: two "
        f"standard errors. Furthest from neutral: {most['image']}."
    )
    body = figure(chart, said)
    body += folded("Every photograph in numbers", _balance_table(rows))
    return Section("white-balance", "White balance", body)


def _triples(values) -> np.ndarray:
    return np.array([[np.nan] * 3 if v is None else v for v in values], float).reshape(-1, 3)


def _balance_table(rows: list[ViewPhotometry]) -> str:
    cells = []
    for v in rows:
        stops = np.log2(v.get("white_balance") or [1.0] * 3)
        errors = v.get("white_balance_ev_error")
        each = [
            f"{stops[c]:+.3f}" + ("" if errors is None else f" ± {errors[c]:.3f}") for c in range(3)
        ]
        cells.append([v["image"], v["camera"], *each])
    names = ["photograph", "camera", *(f"{name}, stops" for name in CHANNELS)]
    return table(names, cells, numbers=range(2, len(names)), tall=True)


def vignetting_section(run: RunFiles) -> Section:
    """How cameras darken towards their corners."""
    shaded = [c for c in _cameras(run) if c["vignetting"]]
    if not shaded:
        return Section("vignetting", "Vignetting", "")
    formations = camera_formations(
        [{"name": c["name"], "vignetting": c["vignetting"], "splines": ()} for c in shaded]
    )
    cfg = PhotometryConfig(cameras=formations)
    r = np.linspace(0, 1, 51)
    light = [100 * np.exp(log_vignetting(r**2, k, cfg)) for k in range(len(formations))]
    if len(formations) > MOST_PANELS:
        every = [Series("", 100 * r, v[:, c], PLAIN) for v in light for c in range(v.shape[1])]
        panels = [ChartPanel(f"{len(formations)} cameras", tuple(every))]
    else:
        panels = [
            ChartPanel(_titled(c.name, formations), _falloff(100 * r, v, len(c.vignetting)))
            for c, v in zip(formations, light, strict=True)
        ]
    chart = panels_chart(
        panels,
        y_label="light that is left, %",
        x_label="distance from the centre, % of the way to the corners",
        label="Vignetting of each camera",
        band=100.0,
    )
    cells = []
    for camera, found in zip(formations, shaded, strict=True):
        errors = found["corner_ev_error"]
        for k, left in enumerate(corner(camera)):
            known = "" if errors is None or k >= len(errors) else f" ± {errors[k]:.2f}"
            which = CHANNELS[k] if len(camera.vignetting) > 1 else "all"
            ev = f"{np.log2(left):+.2f}{known}"
            cells.append([camera.name, which, f"{100 * (1 - left):.0f} %", ev])
    body = figure(
        chart,
        "What the lens leaves of the light, by distance from the image's centre. It is divided out "
        "of what the photographs say of the radiance.",
    )
    names = ["camera", "channels", "lost in the corners", "that is, stops"]
    body += table(names, cells, numbers=range(2, 4))
    return Section("vignetting", "Vignetting", body)


def _titled(name: str, cameras: Sequence) -> str:
    return f"camera {name}" if len(cameras) > 1 else ""


def _falloff(x: np.ndarray, light: np.ndarray, rows: int) -> tuple[Series, ...]:
    if rows == 1:
        return (Series("", x, light[:, 0], PLAIN),)
    return tuple(Series(name, x, light[:, c], LINES[c]) for c, name in enumerate(CHANNELS))


def responses_section(run: RunFiles) -> Section:
    """The curves of cameras and channels that have their own."""
    curved = [c for c in _cameras(run) if c["splines"]]
    if not curved or run.photometry is None:
        return Section("responses", "Responses of cameras", "")
    formations = camera_formations(
        [{"name": c["name"], "vignetting": (), "splines": c["splines"]} for c in curved]
    )
    # With one response per channel for all cameras, the first stands for all.
    if all(c.splines == formations[0].splines for c in formations):
        formations = formations[:1]
    y = np.linspace(0.004, 1.0, 240)
    pivot = float(run.photometry["curve"].get("pivot") or MID_GREY)
    cfg = PhotometryConfig(curve="spline", cameras=formations, pivot=pivot)
    curves = []
    for k, camera in enumerate(formations):
        stops = _stops(np.repeat(y[:, None], 3, 1), k, cfg)
        for c in range(len(camera.splines)):
            named = [camera.name] if len(formations) > 1 else []
            named += [CHANNELS[c]] if len(camera.splines) > 1 else []
            shade = k if len(camera.splines) == 1 else c
            line = DASHES[(c if len(camera.splines) == 1 else k) % len(DASHES)]
            label = " ".join(named) if len(formations) <= MOST_PANELS else ""
            curves.append(ToneCurve(label, stops[:, c], y, COLORS[shade % len(COLORS)], line))
    srgb = np.log2(np.maximum(inverse_tone_map(y, GAMMA_SRGB, PhotometryConfig()), 1e-6) / MID_GREY)
    curves.append(ToneCurve("sRGB", srgb, y, INK, (0, (4, 4))))
    what = "cameras" if len(formations) > 1 else "channels"
    chart = response_chart(curves, label=f"Responses of the {what} against sRGB")
    apart = np.ptp([c.stops for c in curves[:-1]], axis=0)[y > 0.05].max()
    said = (
        f"Each of the {what} has a response of its own; at values above 0.05 they are at most "
        f"{apart:.2f} stops apart. Dashed in ink: sRGB."
    )
    return Section("responses", "Responses of cameras", figure(chart, said))


def _stops(y: np.ndarray, camera: int, cfg: PhotometryConfig) -> np.ndarray:
    linear = inverse_tone_map(y, GAMMA_SRGB, cfg, camera)
    return np.log2(np.maximum(linear, 1e-6) / MID_GREY)
