"""Pictures as data URLs, and the section of held-out views."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.renders_of_others import read_display
from p2gs_jax.formats.false_color import luminance
from p2gs_jax.formats.frames import data_url, shrunk
from p2gs_jax.report.page import paragraph, row, text
from p2gs_jax.report.run_files import RunFiles, number_at

# Longest side of a picture, pixels: a third of the page at double resolution, or the whole page.
SMALL, LARGE = 560, 900
JPEG_QUALITY = 84
MOST_SHOWN = 6  # held-out views on the page
# A difference of 1 / GAIN of the display's range becomes white or black.
GAIN = 4.0


def jpeg(ldr: Float[np.ndarray, "h w 3"], alt: str, longest: int = SMALL) -> str:
    """Return an `img` element of display values; NaN becomes black."""
    small = shrunk(np.nan_to_num(ldr).clip(0, 1), longest)
    return f'<img src="{data_url("jpeg", small, JPEG_QUALITY)}" alt="{text(alt)}">'


def signed_difference(
    render: Float[np.ndarray, "h w 3"], photograph: Float[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return the difference in luminance as a picture: grey where both are equal, lighter where the
    render is too bright."""
    found, true = (luminance(np.nan_to_num(p).clip(0, 1)) for p in (render, photograph))
    shown = np.clip(0.5 + 0.5 * GAIN * (found - true), 0, 1)
    return np.repeat(shown[..., None], 3, -1).astype(np.float32)


def without_suffix(name: str) -> str:
    """Return the name of a view without its last dot and the text behind it."""
    return name.rsplit(".", 1)[0]


def held_out_section(run: RunFiles, problems: list[str]) -> str:
    """Return HTML of at most MOST_SHOWN held-out views, evenly spaced from the worst to the best.

    Each view has its photograph, its render at the fitted exposure, and their difference.
    `problems` receives a sentence for each view that cannot be read.
    """
    scores = run.part("test", "exposure_fitted", "per_view")
    psnr = {h.name: number_at(scores, h.name, "psnr") for h in run.held_out}

    def rank(name: str) -> tuple[float, str]:
        score = psnr[name]
        return np.inf if score is None else score, name

    total, body, shown = len(run.held_out), "", 0
    ranked = sorted(run.held_out, key=lambda h: rank(h.name))
    for files in (ranked[k] for k in evenly_spaced(total, MOST_SHOWN)):
        try:
            photograph, render = read_display(files.photograph), read_display(files.render)
        except UserError as error:
            problems.append(f"{files.name} cannot be displayed: {error.message}")
            continue
        score = psnr[files.name]
        dB = "" if score is None else f" · {score:.1f} dB"
        difference = np.full_like(render, 0.5)
        if render.shape == photograph.shape:
            difference = signed_difference(render, photograph)
        three = {"Photograph": photograph, "Render of": render, "Difference at": difference}
        cells = [(jpeg(p, f"{name} {files.name}"), name.split()[0]) for name, p in three.items()]
        body += f"<h3>{text(without_suffix(files.name))}{text(dB)}</h3>{row(cells, 'three')}"
        shown += 1
    if not shown:
        return ""
    some = "" if shown == total else f" ({shown} of {total}, evenly from the worst to the best)"
    note = (
        f"The fit did not use these photographs{some}. Renders have the exposure fitted to their "
        "photograph. The difference in luminance is grey where both are equal, lighter where the "
        f"render is too bright, else darker; beyond {256 / GAIN:.0f} of 255 levels it is saturated."
    )
    return paragraph(note) + body
