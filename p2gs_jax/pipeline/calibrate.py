"""Photometry without splatting: exposures, gammas and tone curve.

Observations come from the tracks of a scene, through the rendered depth of a finished run, or from
a stack of exposures of one fixed viewpoint; `solved` processes all of them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import no_empty_folders, write_json
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.core.text import count_of, first_few
from p2gs_jax.errors import UserError
from p2gs_jax.export.develop import Developed, Development, develop_scene, places_of
from p2gs_jax.export.poses import poses_of
from p2gs_jax.formats.frames import notebook_html
from p2gs_jax.gaussians.posed import standing
from p2gs_jax.options import check_values
from p2gs_jax.photometry.adjustment.problem import KnownExposures
from p2gs_jax.photometry.calibrate import (
    CalibrationOptions,
    Selection,
    calibrate_observations,
    options_of,
)
from p2gs_jax.photometry.candidates import Candidate
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.solution import Agreement, PhotometricSolution, compare
from p2gs_jax.photometry.sources.points import has_tracks, rendered_colors, surface_colors
from p2gs_jax.photometry.sources.stack import SATURATED, StackColors, read_stack, stack_colors
from p2gs_jax.photometry.unmodelled import LOCAL_EV, regional_ev
from p2gs_jax.pipeline.preflight import check_choice
from p2gs_jax.presets import require_config
from p2gs_jax.run.folder import RunFolder, locked, require_folder
from p2gs_jax.run.photometry_files import write_solution
from p2gs_jax.run.plots import write_calibration_plot
from p2gs_jax.run.read import load_run
from p2gs_jax.scene import PhotographsAlone, check_apart, exposures, load_scene
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import View

STACK_PIVOT = 0.18  # linear value that gammas do not change
MEAN_GAUGE = "mean log exposure is 0 over each connected group of views"
STACK_GAUGE = "mean log exposure is 0; exposures and response can be stretched together"
# Fields of a solution that `calibration.json` holds under the same names.
OF_SOLUTION = (
    *("residual_ev", "view_residual_ev", "view_balance_ev", "outliers", "component"),
    "observations_per_view",
)


@dataclass(frozen=True)
class Calibration:
    """The result of a calibration."""

    # photographs, in the order of the solution; poses in a stack are meaningless
    views: tuple[View, ...]
    selection: Selection  # model, exposures, gammas, errors, reasons
    # exposures from EXIF or a file, stops, shifted onto the recovered ones; NaN where unknown
    stated_ev: Float[np.ndarray, " v"]
    agreement: Agreement  # agreement of stated and recovered exposures
    gauge: str  # convention that fixes the scale, in words
    pivot: float  # linear value that gammas do not change
    messages: tuple[str, ...]  # notes for the user
    details: dict[str, Any]  # other content of `calibration.json`
    observations: int  # number of observations used
    seconds: dict[str, float]  # duration of `reading` with sampling, and of the `adjustment`, s
    developed: Developed | None = None  # photographs for other trainers (`develop`)

    @property
    def solution(self) -> PhotometricSolution:
        """Exposures, gammas, response and their errors, in natural logarithms."""
        return self.selection.solution

    @property
    def exposures_ev(self) -> Float[np.ndarray, " v"]:
        """Recovered exposures, stops."""
        return self.solution.exposures_ev

    @property
    def errors_ev(self) -> Float[np.ndarray, " v"]:
        """Standard errors of the recovered exposures, stops; infinite where they are unknown."""
        return self.solution.exposure_errors_ev

    def write(self, out: Path) -> Calibration:
        """Write `photometry.json`, `calibration.json` and `calibration.png`; return `self`."""
        path, convention = out / "photometry.json", {"pivot": self.pivot, "gauge": self.gauge}
        write_solution(path, self.solution, views=self.views, **convention)
        write_json(out / "calibration.json", {"messages": self.messages, **self.details})
        self._plot(out / "calibration.png")
        return self

    def _plot(self, path: Path) -> None:
        how = {"cameras": [v.camera for v in self.views], "stated_ev": self.stated_ev}
        write_calibration_plot(path, self.solution, pivot=self.pivot, **how)

    def _repr_html_(self) -> str:
        """Return the main numbers and `calibration.png`, for notebooks."""
        s, known = self.solution, np.isfinite(self.errors_ev)
        stops, error = self.exposures_ev[known], self.errors_ev[known].max(initial=0)
        span = f"{stops.min(initial=0):+.2f} to {stops.max(initial=0):+.2f} EV"
        rows = {
            "photographs": f"{len(self.views)}, {known.sum()} with an exposure",
            "model": f"{s.model}, curve {s.response.name}",
            "exposures": f"{span}, standard errors up to {error:.3f} EV",
            "residual": f"{s.residual_ev:.2f} EV over {self.observations:,} observations",
        }
        with tempfile.TemporaryDirectory() as folder:
            self._plot(Path(folder) / "calibration.png")
            return notebook_html(rows, Path(folder) / "calibration.png")


def calibrate(
    scene_dir: str | Path,
    out: str | Path,
    cfg: FitConfig | None = None,
    *,
    compare_with: str | None = None,
    develop: Development | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve the photometry of a scene and write the files of a calibration.

    The scene has any format that `load_scene` reads. The options of data, photometry and the
    thresholds of the loss in `cfg` (default `robust`) apply. The result is compared with stated
    exposures from `exif` or a CSV file, by default those in EXIF, if any. With `develop`, the
    folder `developed` gets the photographs at one exposure, for other trainers. UserError: a fault
    that the user can fix, such as another process that writes to `out`.
    """
    cfg = require_config(cfg)
    check_values(cfg)
    check_choice(cfg.photometry)
    cfg = dataclasses.replace(cfg, data=dataclasses.replace(cfg.data, test_every=0))
    reporter, out, begin = reporter or Silent(), Path(out), time.monotonic()
    for source in (cfg.photometry.known, compare_with):
        exposures.check_source(source)
    reporter.stage("Reading the scene")
    with _held(out):
        scene = load_scene(Path(scene_dir), cfg.data, out / "cache", reporter.message)
        poses = None
        if develop is not None:
            poses = poses_of(scene, out / "cache")
            places_of(poses, scene, out, develop)
        # Every photograph is read once.
        once = dataclasses.replace(cfg.data, cache_mb=0)
        store = ImageStore(scene.views, once, scene.objects).only_opaque()
        if scene.random_seeds or not (has_tracks(scene) or len(scene.points)):
            raise UserError(
                f"{scene_dir} has neither tracks nor points: it is unknown which pixels show the "
                "same surface.",
                fix="give a COLMAP model with its images.bin, or only the photographs",
            )
        observations = surface_colors(
            scene, store, cfg.train.seed, lambda i, n: reporter.stage("Sampling colours", i, n)
        )
        options, views = options_of(cfg, scene), scene.training_views
        notes = (*scene.notes, *exposures.strangers(compare_with, scene.views))
        found = solved(views, observations, options, cfg, begin, compare_with, reporter, notes)
        found.write(out)
        if develop is None or poses is None:
            return found
        done = develop_scene(scene, poses, out, cfg, found.selection, develop, reporter)
        return dataclasses.replace(found, developed=done)


def calibrate_run(
    run_dir: str | Path,
    out: str | Path,
    cfg: FitConfig | None = None,
    *,
    scene: str | Path | None = None,
    compare_with: str | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve the photometry of a finished run's training views again, through its rendered depth.

    The run is not changed. The photometric options of `cfg` (default `robust`) apply, not those of
    the run. `scene` is as for `load_run`, the other arguments are as for `calibrate`.
    UserError: see `load_run`; or the photographs are missing, no pixel of the fit is opaque, its
    views do not overlap, or `out` holds a run or is in use.
    """
    begin, reporter = time.monotonic(), reporter or Silent()
    requested = require_config(cfg)
    check_values(requested)
    check_choice(requested.photometry)
    with _held(Path(out)):
        run = load_run(run_dir, scene)
        cfg = dataclasses.replace(run.cfg, photometry=requested.photometry)
        run.require_photographs(run.scene.train_indices)
        # Only static Gaussians: a moving surface point is elsewhere in another view.
        observations = rendered_colors(
            standing(run.params.gaussians, run.owner),
            run.scene,
            run.store.leaving_out(run.scene.objects),
            cfg.render,
            cfg.train.seed,
            lambda i, n: reporter.stage("Rendering depth", i, n),
        )
        if not len(observations.views):
            fix = "fit longer, or calibrate from the scene's tracks"
            raise UserError(f"{run.folder}: no pixel of one view is visible in another.", fix=fix)
        options, views = options_of(cfg, run.scene), run.scene.training_views
        notes = (*run.scene.notes, *exposures.strangers(compare_with, run.scene.views))
        found = solved(views, observations, options, cfg, begin, compare_with, reporter, notes)
        return found.write(Path(out))


def solved(
    views: Sequence[View],
    observations: Observations,
    options: CalibrationOptions,
    cfg: FitConfig,
    begin: float,
    compare_with: str | None,
    reporter: Reporter,
    notes: Sequence[str] = (),
    *,
    gauge: str = MEAN_GAUGE,
    signal: Bool[np.ndarray, " v"] | bool = True,
) -> Calibration:
    """Solve the photometry of some views, and compare it with stated exposures.

    Reading began at `begin` (`time.monotonic`); `gauge` describes what fixes the scale if `cfg`
    names no known exposures. Views without `signal` are not compared. UserError: there is one view,
    or no observation.
    """
    if len(views) < 2:
        why = f"there is only {views[0].name}; the exposures of photographs are compared."
        raise UserError(why, fix="add photographs of the same surfaces")
    if not len(observations.points):
        fix = "add photographs of the same surfaces; masks are black where pixels are to be ignored"
        raise UserError("no point is visible in two photographs.", fix=fix)
    sampled = time.monotonic()
    reporter.stage("Photometric bundle adjustment")
    selection = calibrate_observations(observations, options)
    seconds = {"reading": sampled - begin, "adjustment": time.monotonic() - sampled}
    s, known = selection.solution, cfg.photometry.known
    stated = exposures.stated_ev(compare_with, list(views))
    agreement = compare(s.exposures_ev, np.where(signal, s.exposure_errors_ev, np.inf), stated)
    messages = [*notes, *selection.reasons, *s.warnings]
    if agreement.views:
        by = "EXIF" if compare_with in (None, "exif") else Path(str(compare_with)).name
        messages.append(agreement.sentence(by))
    details = {
        "observations": len(observations.views),
        "seconds": seconds,
        "solution": s.state,
        **{name: getattr(s, name) for name in OF_SOLUTION},
        "agreement": agreement._asdict(),
        "candidates": [_row(candidate) for candidate in selection.candidates],
    }
    return Calibration(
        views=tuple(views),
        selection=selection,
        stated_ev=stated + agreement.offset_ev,
        agreement=agreement,
        gauge=gauge if known is None else f"known exposures ({known})",
        pivot=options.pivot,
        messages=tuple(messages),
        details=details,
        observations=len(observations.views),
        seconds=seconds,
    )


@contextlib.contextmanager
def _held(out: Path) -> Iterator[None]:
    """Create the folder of a calibration, and hold its lock in a `with` block.

    UserError: it is a file or holds a run, or another process writes to it.
    """
    require_folder(out)
    if RunFolder(out).config.exists():
        why = f"{out} holds a run, whose photometry.json would be replaced."
        raise UserError(why, fix="name another folder with --out")
    with no_empty_folders(out), locked(out):
        yield


def _row(candidate: Candidate) -> dict[str, Any]:
    """Return the entry of a candidate in `calibration.json`."""
    form = candidate.form
    return {
        "model": form.model,
        "white_balance": form.white_balance,
        "vignetting": form.vignetting,
        "curve": candidate.response.name,
        "parameters": candidate.parameters,
        "density": candidate.density,
        "behind": candidate.deficit,
        "behind_error": candidate.deficit_error,
        "codes": candidate.difference,
    }


def calibrate_stack(
    folder: str | Path,
    out: str | Path | None = None,
    cfg: FitConfig | None = None,
    *,
    compare_with: str | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve exposures and the common response of a stack of photographs from one fixed viewpoint.

    Without known exposures, log exposures are determined up to a factor: exposures and response
    can be stretched together. The mid tones of the standard curves fix this power gauge. The
    photometry of `cfg` (default `robust`) names known exposures, and its seed draws the sampled
    positions. Without `out` nothing is written; see `calibrate`.
    UserError: see `read_stack` and `read_known_exposures`; or `out` holds the photographs or a
    run, or is in use.
    """
    cfg, begin, reporter = require_config(cfg), time.monotonic(), reporter or Silent()
    p, seed = cfg.photometry, cfg.train.seed
    check_values(cfg)
    check_choice(p)
    exposures.check_source(compare_with)
    with contextlib.nullcontext() if out is None else _held(Path(out)):
        stack, known = read_stack(Path(folder)), None
        if out is not None:
            paths = [view.image_path for view in stack.views]
            check_apart(Path(out), PhotographsAlone(paths[0].parent, paths))
        if p.known is not None:
            values = exposures.read_known_exposures(p.known, list(stack.views))
            unused = exposures.without_view(p.known, stack.views)
            known = KnownExposures(values, p.known_deviation_ev, unused)
        found = stack_colors(stack, seed)
        options = CalibrationOptions(
            found.black, SATURATED, STACK_PIVOT, known, seed, "one_response"
        )
        arguments = (stack.views, found.observations, options, cfg, begin, compare_with, reporter)
        notes = exposures.strangers(compare_with, stack.views)
        result = solved(*arguments, notes, gauge=STACK_GAUGE, signal=found.signal)
        of_frames = (result.solution, found.xy, stack.valid.shape, found.signal)
        local_ev = regional_ev(options.problem(found.observations), *of_frames)
        details = {
            "signal": found.signal,
            "shifts": found.shifts,
            "black": found.black,
            "one_response": local_ev <= LOCAL_EV,
            "local_ev": local_ev,
        }
        messages = (*result.messages, *_stack_messages(stack.views, found, local_ev))
        details = {**result.details, **details}
        result = dataclasses.replace(result, messages=messages, details=details)
        return result if out is None else result.write(Path(out))


def _stack_messages(views: tuple[View, ...], found: StackColors, local_ev: float) -> list[str]:
    """Return notes on dark frames, on moved frames, and on local tone mapping."""
    out = []
    dark, astray = (
        [view.name for view, of in zip(views, flags, strict=True) if of]
        for flags in (~found.signal, found.astray)
    )
    if dark:
        out.append(f"Nearly all pixels are black or saturated in {first_few(dark)}.")
    moved = np.abs(found.shifts).max()
    if moved > 0:
        out.append(f"Frames were moved by up to {count_of(moved, 'pixel')}.")
    if astray:
        out.append(f"The camera moved too far to align {first_few(astray)} with the frame before.")
    if local_ev > LOCAL_EV:
        out.append(
            f"One response does not explain this stack: between frames, regions of equal "
            f"brightness change by {local_ev:.2f} EV (RMS; one camera pipeline reaches at most "
            f"{LOCAL_EV:g} EV). The frames were tone-mapped by region, or the light changed: do "
            "not trust the exposures."
        )
    return out
