"""Pictures as data URLs, and sections of them: held-out views, radiance in stops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.errors import UserError
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.formats.false_color import STOPS, false_color, luminance
from p2gs_jax.formats.frames import data_url, shrunk, to_uint8
from p2gs_jax.report.page import paragraph, row, text
from p2gs_jax.report.run_files import RunFiles, number_at

# Longest side, pixels: a third of the page on a screen of twice its resolution, and all of it.
SMALL, LARGE = 560, 900
JPEG_QUALITY = 84
# A difference of 1 / GAIN of the display's range is shown as white or black.
GAIN = 4.0
MOST_HDR = 2
MID_GREY = 0.18


@dataclass(frozen=True)
class ViewComparison:
    """A photograph and its render, display values, with radiance and PSNR (dB) where known.

    The render is under the view's own exposure, or under that fitted to its photograph.
    """

    name: str
    split: str
    photograph: Float32[np.ndarray, "h w 3"]
    render: Float32[np.ndarray, "h w 3"]
    linear: Float32[np.ndarray, "h w 3"] | None
    psnr: float | None


def held_out_comparisons(run: RunFiles, most: int, problems: list[str]) -> list[ViewComparison]:
    """Return at most so many held-out views from files: evenly over all, the worst first.

    `problems` receives a sentence for every view that could not be read.
    """
    scores = run.part("test", "exposure_fitted", "per_view")
    psnr = {h.name: number_at(scores, h.name, "psnr") for h in run.held_out}

    def rank(name: str) -> tuple[float, str]:
        score = psnr[name]
        return np.inf if score is None else score, name

    out = []
    for files in spread(sorted(run.held_out, key=lambda h: rank(h.name)), most):
        try:
            photograph, render = read_png(files.photograph), read_png(files.render)
            linear = None if files.exr is None else read_exr(files.exr)[0]
        except UserError as error:
            problems.append(f"{files.name} is not shown: {error.message}.")
            continue
        found = psnr[files.name]
        out.append(ViewComparison(files.name, "test", photograph, render, linear, found))
    return out


def spread(items: Sequence, most: int) -> list:
    """Return at most `most` items, evenly spaced, the first and the last included."""
    return [items[i] for i in evenly_spaced(len(items), most)]


def read_png(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Return display values of a PNG or JPEG; a UserError says that it cannot be read."""
    try:
        raw = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        raw = None
    if raw is None:
        raise UserError(f"{path} cannot be read")
    return raw[..., ::-1].astype(np.float32) / 255


def jpeg(ldr: Float[np.ndarray, "h w 3"], alt: str, longest: int = SMALL) -> str:
    """Return an `img` element of display values; NaN becomes black."""
    small = shrunk(np.nan_to_num(ldr).clip(0, 1), longest)
    return picture(data_url("jpeg", small, JPEG_QUALITY), alt)


def picture(url: str, alt: str) -> str:
    """Return an `img` element."""
    return f'<img src="{url}" alt="{text(alt)}">'


def signed_difference(
    render: Float[np.ndarray, "h w 3"], photograph: Float[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return render minus photograph in luminance: grey where they agree, lighter where the render
    is too bright."""
    bright, there = (luminance(np.nan_to_num(p).clip(0, 1)) for p in (render, photograph))
    shown = np.clip(0.5 + 0.5 * GAIN * (bright - there), 0, 1)
    return np.repeat(shown[..., None], 3, -1).astype(np.float32)


def dynamic_range(linear: Float[np.ndarray, "h w 3"]) -> float:
    """Return the stops between the 0.5th and the 99.5th percentile of luminance."""
    values = luminance(np.nan_to_num(linear))
    values = values[values > 1e-9]
    if values.size == 0:
        return 0.0
    low, high = np.percentile(values, (0.5, 99.5))
    return float(np.log2(high / low))


def without_suffix(name: str) -> str:
    """Return the name of a view without what stands behind its last dot."""
    return name.rsplit(".", 1)[0]


def comparison_section(comparisons: Sequence[ViewComparison], total: int) -> str:
    """Return photographs, renders and their differences; `total` held-out views exist."""
    if not comparisons:
        return ""
    if comparisons[0].split == "test":
        some = f" ({len(comparisons)} of {total}, evenly from the worst to the best)"
        which = "" if len(comparisons) == total else some
        note = (
            f"The fit never saw these photographs{which}; each is rendered at the exposure fitted "
            "to it. "
        )
    else:
        note = "No held-out view could be shown, so these are photographs that the fit knew. "
    body = paragraph(
        f"{note}Difference: in luminance; grey where both agree, lighter where the render is too "
        f"bright, darker where it is too dark, white and black from {128 / GAIN * 2:.0f} of 255 on."
    )
    for s in comparisons:
        score = "" if s.psnr is None else f" · {s.psnr:.1f} dB"
        if s.render.shape == s.photograph.shape:
            difference = signed_difference(s.render, s.photograph)
        else:
            difference = np.full_like(s.render, 0.5)
        shown = {"Photograph": s.photograph, "Render of": s.render, "Difference at": difference}
        cells = [(jpeg(p, f"{what} {s.name}"), what.split()[0]) for what, p in shown.items()]
        body += f"<h3>{text(without_suffix(s.name))}{text(score)}</h3>{row(cells, 'three')}"
    return body


def hdr_section(run: RunFiles, comparisons: Sequence[ViewComparison]) -> str:
    """Return radiance as whole stops, with numbers."""
    known = [(s, s.linear) for s in comparisons if s.linear is not None]
    if not known:
        return ""
    mean = {} if run.photometry is None else run.photometry["mean"]
    middle = MID_GREY / float(mean.get("exposure_geometric") or 1.0)
    # Unseen areas render black: a view that the fit fails at would seem to have the widest range.
    middling = float(np.median([s.psnr or 0.0 for s, _ in known]))
    good = [(s, linear) for s, linear in known if (s.psnr or 0.0) >= middling]
    widest = sorted(good, key=lambda pair: -dynamic_range(pair[1]))[:MOST_HDR]
    body = paragraph(
        "The radiance that the fit holds, before any exposure: one step of the scale is one stop, "
        "a factor of two in light; lighter is brighter. 0 is mid-grey at the mean exposure, and a "
        f"photograph at that exposure is white from about {np.log2(1 / MID_GREY):+.1f} on."
    )
    for s, linear in widest:
        colors = false_color(shrunk(np.maximum(np.nan_to_num(linear), 0), LARGE), middle)
        # Without loss: JPEG would smear flat colours.
        shown = picture(data_url("png", colors), f"Radiance of {s.name} in stops")
        title = f"{without_suffix(s.name)} · {dynamic_range(linear):.1f} stops"
        body += f"<h3>{text(title)}</h3>{shown}"
    return (
        body
        + _legend()
        + paragraph(
            "Stops in the titles lie between the darkest and the brightest half percent of pixels.",
            "note",
        )
    )


def _legend() -> str:
    """Return the colours of whole stops, from the darkest on, with the lower end of each."""
    low, high = (round(v) for v in STOPS)
    steps = np.arange(low, high)
    levels = np.repeat(2.0 ** (steps[None, :, None] + 0.5), 3, -1)
    cells = "".join(
        f'<span style="border-top: 18px solid rgb({",".join(map(str, color))})">{step:+d}</span>'
        for step, color in zip(steps, to_uint8(false_color(levels, 1.0))[0].tolist(), strict=True)
    )
    return f'<div class="stops">{cells}</div>'
