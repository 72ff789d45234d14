"""Sections with pictures: seams, held-out views, radiance in stops."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2gs_jax.formats.false_color import STOPS
from p2gs_jax.report import run_summary
from p2gs_jax.report.page import Section, figure, folded, paragraph, row, table, text
from p2gs_jax.report.pictures import (
    GAIN,
    LARGE,
    dynamic_range,
    jpeg,
    png,
    signed_difference,
    stop_picture,
    stop_shares,
)
from p2gs_jax.report.run_charts import seams_chart
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.report.scene_measurements import SceneMeasurements
from p2gs_jax.report.view_comparisons import ViewComparison

MOST_HDR = 2
MID_GREY = 0.18


def seam_section(scene: SceneMeasurements) -> Section:
    """Differences of neighbouring photographs, as taken and developed alike."""
    title = "Seams before and after"
    if not scene.seams:
        said = " ".join(m for m in scene.missing if m.startswith("Seams"))
        if not said and scene.tried_pairs:
            said = (
                f"None of {scene.tried_pairs} pairs of neighbouring photographs shows enough of "
                "the same unsaturated surface to compare."
            )
        said = said or "No two training views share enough of the scene to be compared."
        return Section("seams", title, paragraph(said))
    before, after = run_summary.seam_medians(scene)
    step = float(np.median([abs(p.seam.step_ev) for p in scene.seams]))
    said = f"{step:.2f}" if step >= 0.005 else "less than 0.01"
    body = paragraph(
        f"The same surfaces in neighbouring photographs differ by {before:.2f} stops as taken, and "
        f"by {after:.2f} once each photograph is decoded, divided by its exposure and developed "
        f"alike (medians over {run_summary.count(len(scene.seams), 'pair')}). Of what is left, "
        f"{said} stops are a step that runs through the whole pair; the rest is texture that "
        "does not meet exactly, shine, and what the formation model leaves out."
    )
    if scene.picture is not None and scene.shown is not None:
        body += _seam_picture(scene)
    rows = [(_pair(p.first, p.second), p.seam.before_ev, p.seam.after_ev) for p in scene.seams]
    chart = seams_chart(rows, label="Difference of pairs of photographs as taken and developed")
    said = (
        "Median absolute difference over all pixels that both photographs show, found through the "
        "rendered depth; saturated and black pixels are left out."
    )
    body += figure(chart, said)
    numbers = [
        [
            _pair(p.first, p.second),
            f"{p.seam.before_ev:.3f}",
            f"{p.seam.after_ev:.3f}",
            f"{p.seam.step_ev:+.3f}",
            f"{p.seam.before_codes:.1f}",
            f"{p.seam.after_codes:.1f}",
            f"{p.seam.pixels:,}",
        ]
        for p in scene.seams
    ]
    heads = ["pair", "before, stops", "after, stops", "step after, stops"]
    heads += ["before, 8-bit levels", "after, 8-bit levels", "pixels"]
    body += folded("Every pair in numbers", table(heads, numbers, numbers=range(1, 7), tall=True))
    return Section("seams", title, body)


def _pair(first: str, second: str) -> str:
    return f"{_short(first)} – {_short(second)}"


def _short(name: str) -> str:
    return name.rsplit(".", 1)[0]


def _seam_picture(scene: SceneMeasurements) -> str:
    assert scene.picture is not None
    assert scene.shown is not None
    names = [_short(scene.shown.first), _short(scene.shown.second)]
    left, right = names if scene.picture.left_first else names[::-1]
    seam = scene.shown.seam
    cells = [
        (
            jpeg(scene.picture.before, f"{left} beside {right}, as taken", LARGE),
            f"As taken: {seam.before_ev:.2f} stops, {seam.before_codes:.0f} 8-bit levels apart",
        ),
        (
            jpeg(scene.picture.after, f"{left} beside {right}, developed alike", LARGE),
            f"Developed alike: {seam.after_ev:.2f} stops, {seam.after_codes:.1f} levels apart",
        ),
    ]
    said = (
        f"Left half: {left}. Right half: {right}. Both as a camera halfway between them would see "
        "them, with a hard edge in the middle: the widest seam among pairs with a good overlap. "
        "Clipped skies stay at the value of their white; grey was out of the photograph's sight."
    )
    return figure(row(cells, "two"), said)


def comparison_section(comparisons: Sequence[ViewComparison], total: int) -> Section:
    """Photographs, renders and their differences.

    Args:
        comparisons: what to show.
        total: how many held-out views there are.
    """
    if not comparisons:
        return Section("views", "Held-out views", "")
    held_out = comparisons[0].split == "test"
    if held_out:
        title = "Held-out views"
        said = (
            "The fit never saw these photographs; each is rendered at the exposure fitted to it. "
            if len(comparisons) == total
            else f"The fit never saw these photographs ({len(comparisons)} of {total}, evenly from "
            "the worst to the best); each is rendered at the exposure fitted to it. "
        )
    else:
        title = "Training views"
        said = "No held-out view could be shown, so these are photographs that the fit knew. "
    said += (
        "Difference: in luminance; grey where both agree, lighter where the render is too bright, "
        f"darker where it is too dark, white and black from {128 / GAIN * 2:.0f} of 255 on."
    )
    body = paragraph(said)
    for s in comparisons:
        score = "" if s.psnr is None else f" · {s.psnr:.1f} dB"
        cells = [
            (jpeg(s.photograph, f"Photograph {s.name}"), "Photograph"),
            (jpeg(s.render, f"Render of {s.name}"), "Render"),
            (jpeg(_difference(s), f"Difference at {s.name}"), "Difference"),
        ]
        body += f"<h3>{text(_short(s.name))}{text(score)}</h3>{row(cells, 'three')}"
    return Section("views", title, body)


def _difference(s: ViewComparison) -> np.ndarray:
    if s.render.shape != s.photograph.shape:
        return np.full_like(s.render, 0.5)
    return signed_difference(s.render, s.photograph)


def hdr_section(run: RunFiles, comparisons: Sequence[ViewComparison]) -> Section:
    """Radiance as whole stops, with numbers."""
    known = [s for s in comparisons if s.linear is not None]
    title = "Radiance in stops"
    if not known:
        return Section("hdr", title, "")
    mean = {} if run.photometry is None else run.photometry["mean"]
    exposure = float(mean.get("exposure_geometric") or 1.0)
    middle = MID_GREY / exposure
    # Unseen areas render black: a view that the fit fails at would seem to have the widest range.
    middling = float(np.median([s.psnr or 0.0 for s in known]))
    good = [s for s in known if (s.psnr or 0.0) >= middling]
    widest = sorted(good, key=lambda s: -dynamic_range(_linear(s)))[:MOST_HDR]
    low, high = (round(v) for v in STOPS)
    body = paragraph(
        "The radiance that the fit holds, before any exposure: one step of the scale is one stop, "
        "a factor of two in light; lighter is brighter. 0 is mid-grey at the mean exposure, and a "
        f"photograph at that exposure is white from about {np.log2(1 / MID_GREY):+.1f} on."
    )
    for s in widest:
        linear = _linear(s)
        picture = png(stop_picture(linear, middle), f"Radiance of {s.name} in stops")
        legend = _legend(stop_shares(linear, middle), low, high)
        body += (
            f"<h3>{text(_short(s.name))} · {dynamic_range(linear):.1f} stops</h3>"
            f'<div class="row two legend"><div>{picture}</div><div>{legend}</div></div>'
        )
    body += paragraph(
        "Stops in the titles lie between the darkest and the brightest half percent of the pixels. "
        "Bars: share of the pixels in each step.",
        "note",
    )
    return Section("hdr", title, body)


def _linear(s: ViewComparison) -> np.ndarray:
    assert s.linear is not None
    return s.linear


def _legend(shares, low: int, high: int) -> str:
    most = max(share for _, share, _ in shares) or 1.0
    cells = []
    for stop, share, color in shares:
        said = f"{stop:+d} to {stop + 1:+d}"
        if stop == high - 1:
            said = f"above {stop:+d}"
        elif stop == low:
            said = f"below {stop + 1:+d}"
        rgb = ",".join(str(round(255 * c)) for c in color)
        cells.append(
            f'<span class="from">{said.replace("-", "−").replace("+0", "0")}</span>'
            f'<span class="swatch" style="background:rgb({rgb})"></span>'
            f'<span class="share">{share:.0%}</span>'
            f'<span><span class="bar" style="display:block;width:{100 * share / most:.1f}%">'
            "</span></span>"
        )
    return f'<div class="stops">{"".join(cells)}</div>'
