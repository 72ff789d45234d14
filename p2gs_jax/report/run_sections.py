"""Sections on scores, depth, training and options."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.scores import PROTOCOLS
from p2gs_jax.presets import flat, preset, to_dict
from p2gs_jax.report.charts import training_chart
from p2gs_jax.report.findings import cell, column, duration
from p2gs_jax.report.page import figure, folded, paragraph, table, text
from p2gs_jax.report.run_files import RunFiles, number_at

MOST_TERMS = 3  # terms of the loss in the chart
SCORES = {"psnr": ".2f", "ssim": ".4f", "lpips": ".4f"}
RADIANCE = {
    "pu21_psnr": "PU21 PSNR {:.2f} dB",
    "pu21_ssim": "PU21 SSIM {:.4f}",
    "delta_e_itp": "colour difference {:.1f} ΔE ITP",
    "mu_law_psnr": "mu-law PSNR {:.2f} dB",
}
# Names in `metrics.json`: protocols with scores by part, parts of a view, splits, and depth errors.
BY_PART = ("train", "test_averaged", "test_fitted", "test_metered")
PARTS = {"whole": "all", "static": "static", "moving": "moving"}
SPLITS = {"all": "all", "held_out": "held out"}
DEPTH = ("median_m", "median_relative", "within_10_percent", "missing")


def _scores(run: RunFiles, *path: str) -> list[str]:
    """Return PSNR, SSIM and LPIPS at a path of `metrics.json`, each "" if it is missing."""
    return [cell(run.number(*path, name), form) for name, form in SCORES.items()]


def _numbers(names: list[str], rows: list[list[str]], first: int, note: str = "") -> str:
    """Return a table without empty columns, and a note; columns from `first` on hold numbers."""
    if not rows:
        return ""
    kept = [i for i in range(len(names)) if i < first or any(r[i] for r in rows)]
    rows = [[r[i] for i in kept] for r in rows]
    body = table([names[i] for i in kept], rows, numbers=range(first, len(kept)))
    return body + (paragraph(note, "note") if note else "")


def score_section(run: RunFiles) -> str:
    """Return a table of scores by protocol."""
    rows = [[p.views, p.shown, *_scores(run, *p.path)] for p in PROTOCOLS.values()]
    names = ["views", "rendered with", "PSNR, dB", "SSIM", "LPIPS"]
    body = _numbers(names, [r for r in rows if r[2] or r[3]], 2)
    return body + _radiance(run)


def _radiance(run: RunFiles) -> str:
    median, rms = (run.number("radiance", name) for name in ("stops_median", "stops_rms"))
    if median is None or rms is None:
        return ""
    known = {form: run.number("radiance", name) for name, form in RADIANCE.items()}
    more = "".join("; " + form.format(v) for form, v in known.items() if v is not None)
    return paragraph(
        f"The error against the true radiance of the scene, after one common scale: {median:.3f} "
        f"stops (median), {rms:.3f} stops (RMS){more}."
    )


def parts_section(run: RunFiles) -> str:
    """Return a table of scores over all, static and moving pixels of drives."""
    rows = []
    for name, (part, pixels) in itertools.product(BY_PART, PARTS.items()):
        views, shown, path = PROTOCOLS[name]
        scores, seen = _scores(run, *path, part), run.number(*path, part, "views")
        if scores[0] and seen is not None:
            rows.append([views, shown, pixels, *scores, f"{seen:.0f}"])
    names = ["views", "rendered with", "pixels", "PSNR, dB", "SSIM", "LPIPS", "number of views"]
    note = (
        "Moving pixels are in the boxes of objects that move at some time. SSIM is computed on the "
        "whole image and averaged over the pixels. The last column counts views with such pixels."
    )
    return _numbers(names, rows, 3, note)


def depth_section(run: RunFiles) -> str:
    """Return a table of errors of rendered depth at LiDAR points."""
    rows = []
    for (split, views), part in itertools.product(SPLITS.items(), ("static", "moving")):
        found = run.part("depth", split, part)
        points = number_at(found, "points")
        if points is not None:
            cells = [_depth(found, name) for name in DEPTH]
            rows.append([views, PARTS[part], *cells, f"{points:,.0f}"])
    names = ["views", "points", "median error", "relative", "within 10 %", "no surface", "count"]
    note = (
        "The rendered depth is compared at the LiDAR points of the sweep nearest in time to each "
        "view. Points hidden by nearer points do not count. Points in moving boxes are moved to "
        "the time of the view. If the render has no surface at a point, the error is infinite."
    )
    return _numbers(names, rows, 2, note)


def _depth(found: dict[str, Any], name: str) -> str:
    value = number_at(found, name)
    if value is None:  # an infinite median: more than half of the points have no surface
        return "none"
    return f"{value:.2f} m" if name == "median_m" else f"{value:.1%}"


def training_section(run: RunFiles) -> str:
    """Return a chart of loss, PSNR and number of Gaussians over the steps."""
    log = [r for r in run.log if number_at(r, "gaussians") is not None]
    if len(log) < 2:
        return paragraph("There are no curves; the list of missing parts gives the reason.")

    def over_steps(*path: str) -> np.ndarray:
        return column(number_at(r, *path) for r in log)

    terms = sorted({name for r in log for name in r.get("terms") or {}})
    values = {n: v for n in terms if np.isfinite(v := over_steps("terms", n)).any()}
    medians = {n: float(np.nanmedian(v)) for n, v in values.items()}
    # Very small terms would only stretch the axis.
    large = [n for n in medians if medians[n] > 1e-3 * max(medians.values())]
    ranked = sorted(large, key=lambda n: -medians[n])[:MOST_TERMS]
    losses = {"loss": over_steps("loss")} | {n.replace("_", " "): values[n] for n in ranked}
    losses = {n: np.where(v > 0, v, np.nan) for n, v in losses.items()}
    steps, psnr, gaussians = (over_steps(name) for name in ("step", "psnr", "gaussians"))
    marks = _marks(log)
    chart = training_chart(steps, psnr, losses, gaussians, [step for step, _ in marks])
    caption = (
        "The numbers are from log.jsonl. Strong lines are running medians; the pale line has every "
        "entry. An entry is the mean of a few training views, some of which are harder to fit."
    )
    if marks:
        caption += f" Dotted: {'; '.join(f'{size} from step {step:.0f}' for step, size in marks)}."
    seconds = number_at(log[-1], "seconds")
    if seconds is not None:
        caption += f" The last step ended after {duration(seconds)}."
    return figure(chart, caption)


def _marks(log: Sequence[dict[str, Any]]) -> list[tuple[float, str]]:
    """Return the steps at which training images grow, and the new sizes in words."""
    out = []
    for before, now in itertools.pairwise(log):
        a, b = number_at(before, "shrink"), number_at(now, "shrink")
        if a is not None and b is not None and a != b:
            size = "full-size images" if b == 1 else f"images at 1/{b:.0f}"
            out.append((number_at(now, "step") or 0.0, size))
    return out


def configuration_section(run: RunFiles) -> str:
    """Return the options; those that differ from the preset come first."""
    if not run.options:
        return ""
    try:
        base = flat(to_dict(preset(run.preset)))  # pyright: ignore[reportArgumentType]
    except UserError:
        base = {}
    differs = [
        [name, option_text(value), option_text(base[name]) if name in base else ""]
        for name, value in flat(run.options).items()
        if option_text(value) != option_text(base.get(name))
    ]
    body = paragraph(f"Preset: {run.preset}. Scene: {run.scene}.")
    if base:
        same = paragraph("All options are as in the preset.")
        body += table(["option", "this run", "preset"], differs) if differs else same
    dump = text(json.dumps(run.options, indent=2))
    return body + folded("The whole configuration (config.json)", f'<pre tabindex="0">{dump}</pre>')


def option_text(value: Any) -> str:
    """Return the value of an option as text."""
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(option_text, value)) + "]"
    return "none" if value is None else str(value)
