"""Measurements on the scene for the report, and its section on seams."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from p2gs_jax.core.progress import Reporter
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.seams import (
    Photographed,
    Seam,
    SeamPicture,
    measure_seam,
    neighbouring_pairs,
    seam_picture,
)
from p2gs_jax.render.warp import surface_depth
from p2gs_jax.report.page import figure, paragraph, row, table
from p2gs_jax.report.pictures import LARGE, jpeg, without_suffix
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.run.read import Run, load_run
from p2gs_jax.scene.pixels.store import camera_of
from p2gs_jax.synth.sensor import read_true_exposures

MOST_PAIRS = 12
# Seams are measured on images at most this wide, pixels.
SEAM_WIDTH = 960
# The pair in the picture of a seam has at least this share of the median overlap.
LEAST_OVERLAP = 0.5
# Columns of the table of seams: field, heading and format.
COLUMNS = (
    ("before_ev", "as recorded, stops", ".3f"),
    ("after_ev", "at one exposure, stops", ".3f"),
    ("step_ev", "step after, stops", "+.3f"),
    ("before_codes", "as recorded, 8-bit levels", ".1f"),
    ("after_codes", "at one exposure, 8-bit levels", ".1f"),
    ("pixels", "pixels", ","),
)


@dataclass
class SceneMeasurements:
    """Measurements on the scene; `missing` holds sentences on those that failed.

    True exposures are by name of the view, if the scene has them. Seams are by the names of their
    two views, in the order of the views; `tried_pairs` counts the compared pairs (None: nothing was
    measured). `picture` shows the pair `shown`, which has the widest seam.
    """

    true_exposures: dict[str, float] = field(default_factory=dict)
    seams: dict[tuple[str, str], Seam] = field(default_factory=dict)
    tried_pairs: int | None = None
    shown: tuple[str, str] | None = None
    picture: SeamPicture | None = None
    missing: tuple[str, ...] = ()


def measure_scene(files: RunFiles, reporter: Reporter, *, render: bool = True) -> SceneMeasurements:
    """Load the scene and measure exposures and seams; failures are listed in `missing`.

    If `render` is False, only the true exposures are read.
    """
    out = SceneMeasurements()
    try:
        out.true_exposures = read_true_exposures(files.scene)
    except UserError as error:
        out.missing += (error.message,)
    if not render:
        out.missing += ("Seams were not measured: the page was made without rendering.",)
        return out
    reporter.stage("Reading the scene")
    try:
        run = load_run(files.folder, files.scene_argument)
        run.require_photographs()
        _measure_seams(run, out, reporter)
    except UserError as error:
        why = f"Seams were not measured, and nothing was rendered: {error.message}"
        return SceneMeasurements(out.true_exposures, missing=(*out.missing, why))
    return out


def _measure_seams(run: Run, out: SceneMeasurements, reporter: Reporter) -> None:
    """Measure seams between neighbouring photographs, and draw the widest one."""
    if run.cfg.photometry.appearance is not None:
        out.missing += (
            "Seams were not measured: this preset learns corrections of display values, which "
            "cannot be removed from a photograph.",
        )
        return
    store, names = run.store.leaving_out(run.scene.objects), [v.name for v in run.scene.views]

    @functools.cache
    def photographed(index: int) -> Photographed:
        """Return a photograph with its rendered depth; each view is rendered once."""
        shrink = max(1.0, store.camera(index)[2] / SEAM_WIDTH)
        camera = camera_of(store, index, shrink)
        depth = np.asarray(surface_depth(run.render(camera)))
        ldr, mask = store.get(index, shrink)
        return Photographed(ldr, mask, camera, depth, run.own_display(index))

    pairs = neighbouring_pairs(run.scene, MOST_PAIRS)
    found: dict[tuple[int, int], Seam] = {}
    for done, (i, j) in enumerate(pairs):
        reporter.stage("Measuring seams", done, len(pairs))
        seam = measure_seam(photographed(i), photographed(j), run.common_display(), run.cfg.loss)
        if seam is not None:
            found[i, j] = seam
    out.tried_pairs = len(pairs)
    out.seams = {(names[i], names[j]): seam for (i, j), seam in found.items()}
    if found:
        enough = LEAST_OVERLAP * float(np.median([seam.pixels for seam in found.values()]))
        good = [rows for rows, seam in found.items() if seam.pixels >= enough]
        i, j = max(good, key=lambda rows: found[rows].before_ev)
        out.shown = names[i], names[j]
        both = photographed(i), photographed(j)
        out.picture = seam_picture(*both, run.common_display(), run.render)


def seam_medians(seams: Iterable[Seam]) -> tuple[float, float]:
    """Return the medians over pairs of `before_ev` and `after_ev`, stops."""
    before, after = np.median([(seam.before_ev, seam.after_ev) for seam in seams], 0)
    return float(before), float(after)


def seam_section(measured: SceneMeasurements) -> str:
    """Return the seams between neighbouring photographs, as recorded and at one exposure."""
    seams = measured.seams
    if not seams:
        if measured.tried_pairs is None:
            return paragraph("No seam was measured; the list of missing parts gives the reason.")
        return paragraph(
            f"{measured.tried_pairs} pairs of training views share enough points, but no pair shows"
            " enough of the same unsaturated surface for a comparison."
        )
    before, after = seam_medians(seams.values())
    step = float(np.median([abs(seam.step_ev) for seam in seams.values()]))
    shown = f"{step:.2f}" if step >= 0.005 else "less than 0.01"
    pairs = "1 pair" if len(seams) == 1 else f"{len(seams)} pairs"
    body = paragraph(
        "The brightness of the same surfaces in neighbouring photographs differs by "
        f"{before:.2f} stops as recorded, and by {after:.2f} stops after conversion to one "
        f"exposure (medians over {pairs}). The visible step between two photographs is then "
        f"{shown} stops. The rest is misaligned texture, gloss, and effects outside the model."
    )
    if measured.picture is not None and measured.shown is not None:
        body += _seam_picture(measured.shown, seams[measured.shown], measured.picture)
    heads = ["pair", *(head for _, head, _ in COLUMNS)]
    rows = []
    for names, seam in seams.items():
        numbers = [format(getattr(seam, name), form) for name, _, form in COLUMNS]
        rows.append([" – ".join(map(without_suffix, names)), *numbers])
    note = (
        "The numbers are median absolute differences over all pixels that both photographs show "
        "according to the rendered depth. Saturated and black pixels do not count."
    )
    return body + table(heads, rows, numbers=range(1, 7), tall=True) + paragraph(note, "note")


def _seam_picture(names: tuple[str, str], seam: Seam, picture: SeamPicture) -> str:
    left, right = map(without_suffix, names if picture.left_first else names[::-1])
    cells = [
        (
            jpeg(image, f"{left} beside {right}, {kind}", LARGE),
            f"{kind.capitalize()}: a difference of {ev:.2f} stops, or {codes:.0f} 8-bit levels",
        )
        for image, kind, ev, codes in (
            (picture.before, "as recorded", seam.before_ev, seam.before_codes),
            (picture.after, "at one exposure", seam.after_ev, seam.after_codes),
        )
    ]
    caption = (
        f"Left half: {left}. Right half: {right}. Both are warped to a camera halfway between "
        "them, with a hard edge in the middle. This pair has the widest seam of all pairs with "
        "enough overlap. Clipped skies keep the value of white; grey pixels are outside the "
        "photograph."
    )
    return figure(row(cells, "two"), caption)
