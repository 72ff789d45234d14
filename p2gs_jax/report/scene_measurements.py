"""What a page needs from the scene itself: seams, clipped photographs, true exposures, renders."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from p2gs_jax.core.progress import Reporter
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.scores import psnr
from p2gs_jax.evaluation.seams import (
    Photographed,
    Seam,
    SeamPicture,
    measure_seam,
    neighbouring_pairs,
    seam_picture,
)
from p2gs_jax.photometry.display import develop
from p2gs_jax.render.warp import surface_depth
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.report.view_comparisons import ViewComparison, spread
from p2gs_jax.run.read import Run, load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.synth.exposures import read_true_exposures

MOST_PAIRS, MOST_CLIPPED, MOST_RENDERED = 12, 24, 3
# Seams are measured on images of at most this many pixels across.
SEAM_WIDTH = 960
# The pair for the picture of a seam has at least this share of the median overlap.
LEAST_OVERLAP = 0.5


@dataclass(frozen=True)
class SeamPair:
    """A seam between two views.

    Attributes:
        first: name of one view.
        second: name of the other.
        seam: between them.
    """

    first: str
    second: str
    seam: Seam


@dataclass(frozen=True)
class SceneMeasurements:
    """What was measured on the scene.

    Attributes:
        true_exposures: by view, where the scene has them.
        seams: pairs in the order of the views.
        tried_pairs: number of pairs that were compared, with or without enough in common.
        shown: the pair of the picture.
        picture: of the widest seam, or None.
        clipped: share of clipped pixels by view, for a sample of the training views.
        comparisons: rendered training views, where the folder has no held-out ones.
        missing: sentences on what could not be measured.
    """

    true_exposures: dict[str, float] = field(default_factory=dict)
    seams: tuple[SeamPair, ...] = ()
    tried_pairs: int = 0
    shown: SeamPair | None = None
    picture: SeamPicture | None = None
    clipped: dict[str, float] = field(default_factory=dict)
    comparisons: tuple[ViewComparison, ...] = ()
    missing: tuple[str, ...] = ()


def measure_scene(files: RunFiles, reporter: Reporter, *, render: bool = True) -> SceneMeasurements:
    """Load the scene and measure what the page needs; without a scene, say so in `missing`.

    Args:
        files: the run folder.
        reporter: receives progress.
        render: False reads only the true exposures.
    """
    truth: dict[str, float] = {}
    missing: list[str] = []
    try:
        truth = read_true_exposures(files.scene)
    except (OSError, KeyError, ValueError) as error:
        missing.append(f"The scene's true exposures cannot be read ({error!r}).")
    if not render:
        missing.append("Seams were not measured: the page was made without rendering.")
        return SceneMeasurements(true_exposures=truth, missing=tuple(missing))
    reporter.stage("Reading the scene")
    try:
        run = load_run(files.folder, files.given)
        run.require_photographs()
        return _rendered(run, files, reporter, truth, missing)
    except UserError as error:
        missing.append(f"Seams were not measured, and nothing was rendered: {error.message}")
        return SceneMeasurements(true_exposures=truth, missing=tuple(missing))


def _rendered(
    run: Run, files: RunFiles, reporter: Reporter, truth: dict[str, float], missing: list[str]
) -> SceneMeasurements:
    store, render_camera = run.store, run.render
    pairs: list[SeamPair] = []
    tried: list[tuple[int, int]] = []
    shown, picture = None, None
    if run.cfg.photometry.appearance is not None:
        missing.append(
            "Seams were not measured: this preset learns corrections of display values, which "
            "cannot be undone in a photograph."
        )
    else:
        tried = neighbouring_pairs(run.scene, MOST_PAIRS)
        photographed = _Photographs(run, store.leaving_out(run.scene.objects), render_camera)
        found: dict[tuple[int, int], Seam] = {}
        for done, (i, j) in enumerate(tried):
            reporter.stage("Measuring seams", done, len(tried))
            seam = measure_seam(
                photographed(i), photographed(j), run.common_display(), run.cfg.loss
            )
            if seam is not None:
                found[i, j] = seam
        names = [v.name for v in run.scene.views]
        pairs = [SeamPair(names[i], names[j], seam) for (i, j), seam in found.items()]
        widest = _widest(found)
        if widest is not None:
            i, j = widest
            shown = SeamPair(names[i], names[j], found[widest])
            picture = seam_picture(
                photographed(i), photographed(j), run.common_display(), render_camera
            )
    comparisons: list[ViewComparison] = []
    if not files.held_out:
        for index in spread(run.scene.train_indices, MOST_RENDERED):
            reporter.stage("Rendering views", len(comparisons), MOST_RENDERED)
            comparisons.append(_comparison(run, store, render_camera, index))
    reporter.stage("Looking for clipped pixels")
    return SceneMeasurements(
        truth,
        tuple(pairs),
        len(tried),
        shown,
        picture,
        _clipped(run, store.only_opaque()),
        tuple(comparisons),
        tuple(missing),
    )


class _Photographs:
    """Photographs with rendered depth, each rendered once."""

    def __init__(self, run: Run, store: ImageStore, render):
        self.run, self.store, self.render = run, store, render
        self.known: dict[int, Photographed] = {}

    def __call__(self, index: int) -> Photographed:
        if index not in self.known:
            shrink = max(1.0, self.store.camera(index)[2] / SEAM_WIDTH)
            camera = camera_of(self.store, index, shrink)
            depth = np.asarray(surface_depth(self.render(camera)))
            ldr, mask = self.store.get(index, shrink)
            transform = self.run.own_display(index)
            self.known[index] = Photographed(ldr, mask, camera, depth, transform)
        return self.known[index]


def _widest(found: dict[tuple[int, int], Seam]) -> tuple[int, int] | None:
    """Return the pair with the widest seam among those with enough overlap."""
    if not found:
        return None
    enough = LEAST_OVERLAP * float(np.median([s.pixels for s in found.values()]))
    good = {k: s for k, s in found.items() if s.pixels >= enough}
    return max(good, key=lambda k: good[k].before_ev)


def _comparison(run: Run, store: ImageStore, render, index: int) -> ViewComparison:
    photograph, mask = store.get(index)
    rendered = render(camera_of(store, index))
    linear = np.asarray(rendered.linear)
    shown = develop(linear, run.own_display(index), alpha=rendered.alpha)
    score = float(psnr(shown, photograph, mask))
    view = run.scene.views[index]
    return ViewComparison(view.name, view.split, photograph, shown, linear, score)


def _clipped(run: Run, store: ImageStore) -> dict[str, float]:
    """Return the share of pixels with a clipped channel, for a sample of the training views."""
    out = {}
    for index in spread(run.scene.train_indices, MOST_CLIPPED):
        ldr, mask = store.get(index)
        clipped = np.any(ldr >= run.cfg.loss.saturation, axis=-1) & (mask > 0)
        out[run.scene.views[index].name] = float(clipped.sum() / max(float(mask.sum()), 1.0))
    return out


def true_stops(names: list[str], truth: dict[str, float]) -> np.ndarray:
    """Return true exposures in stops, NaN where unknown."""
    return np.array([np.log2(truth[n]) if truth.get(n, 0) > 0 else np.nan for n in names])
