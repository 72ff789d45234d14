"""Photometry alone: exposures, gammas and tone curve of a scene in seconds, without splatting."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2gs_jax.config import FitConfig, require_config
from p2gs_jax.core.atomic import no_empty_folders, write_json
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.agreement import Agreement, compare
from p2gs_jax.photometry.selection import Selection
from p2gs_jax.photometry.solution import LADDER
from p2gs_jax.photometry.sources.tracks import has_tracks, surface_colors
from p2gs_jax.pipeline.prepare import calibrate_observations
from p2gs_jax.run.calibration_plot import write_calibration_plot
from p2gs_jax.run.photometry_file import write_solution
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.known_exposures import check_source, stated_ev
from p2gs_jax.types import Scene

WEAK_GAMMA = 0.1
LEVELS = (0.05, 0.1, 0.18, 0.3, 0.5, 0.8)
BETTER = 0.8


@dataclass(frozen=True)
class Calibration:
    """What `p2gs-jax calibrate` finds.

    Attributes:
        scene: all its views are used.
        selection: model, exposures, gammas, errors, reasons.
        stated_ev: exposures from EXIF or a file, stops, laid over the recovered ones; NaN where
            unknown.
        stated_by: what stated them, for reports.
        agreement: of the two.
        level_note: where in the tonal range they agree better, if anywhere.
        observations: used.
        seconds: of reading and sampling, and of the adjustment.
    """

    scene: Scene
    selection: Selection
    stated_ev: np.ndarray
    stated_by: str
    agreement: Agreement
    level_note: list[str]
    observations: int
    seconds: dict[str, float]

    @property
    def messages(self) -> list[str]:
        """What the user should know, in plain words."""
        s = self.selection.solution
        out = [*self.scene.notes, *self.selection.reasons, *s.warnings]
        if self.agreement.views:
            out.append(self.agreement.sentence(self.stated_by))
            out += self.level_note
        return out


def calibrate(
    scene_dir: str | Path,
    out: str | Path,
    cfg: FitConfig | None = None,
    *,
    compare_with: str | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve the photometry of a scene and write `photometry.json` and `calibration.png`.

    Args:
        scene_dir: COLMAP model, transforms.json, or folder of photographs.
        out: folder for the results; created.
        cfg: options (data, photometry and the thresholds of loss); default `robust`.
        compare_with: stated exposures to compare with: `exif` or a CSV file; default EXIF where
            photographs carry it.
        reporter: receives progress.

    Raises:
        UserError: something the user can mend.
    """
    cfg = require_config(cfg)
    cfg = dataclasses.replace(cfg, data=dataclasses.replace(cfg.data, test_every=0))
    reporter = reporter or Silent()
    out = Path(out)
    begin = time.monotonic()
    check_source(cfg.photometry.known)
    check_source(compare_with)
    reporter.stage("Reading the scene")
    with no_empty_folders(out):
        scene = load_scene(Path(scene_dir), cfg.data, out / "cache", reporter.message)
        store = ImageStore(scene.views, cfg.data)
        if not (has_tracks(scene) or len(scene.points)):
            raise UserError(
                f"{scene_dir} has neither tracks nor points: which pixels show the same surface is "
                "not known.",
                fix="give a COLMAP model with its images.bin, or the photographs alone",
            )
        observations = surface_colors(
            scene, store, cfg.train.seed, lambda i, n: reporter.stage("Sampling colours", i, n)
        )
        sampled = time.monotonic()
    reporter.stage("Photometric bundle adjustment")
    selection = calibrate_observations(observations, scene, cfg)
    solved = time.monotonic()
    seconds = {"reading": sampled - begin, "adjustment": solved - sampled}
    return conclude(
        scene, selection, len(observations.views), seconds, out, cfg, compare_with=compare_with
    )


def conclude(
    scene: Scene,
    selection: Selection,
    observations: int,
    seconds: dict[str, float],
    out: Path,
    cfg: FitConfig,
    *,
    compare_with: str | None,
) -> Calibration:
    """Compare a solution with stated exposures and write the files.

    Args:
        scene: its views are those of the solution.
        selection: the solution.
        observations: how many it used.
        seconds: see `Calibration`.
        out: folder.
        cfg: options.
        compare_with: see `calibrate`.
    """
    stated = stated_ev(compare_with, list(scene.views))
    s = selection.solution
    agreement = compare(s.exposures_ev, s.exposure_errors / LN2, stated)
    note = _level_note(selection, stated, agreement, cfg.photometry.pivot)
    laid_over = stated + agreement.offset_ev
    source = "EXIF" if compare_with in (None, "exif") else Path(str(compare_with)).name
    result = Calibration(
        scene, selection, laid_over, source, agreement, note, observations, seconds
    )
    _write(result, out, cfg)
    return result


def _level_note(selection: Selection, stated, agreement: Agreement, pivot: float) -> list[str]:
    """Say at which level stated exposures agree best, where gammas make them depend on it."""
    s = selection.solution
    if LADDER[s.model].gamma is None or agreement.views < 3:
        return []
    errors = s.exposure_errors / LN2
    options = {x: compare(s.exposures_ev_at(x, pivot), errors, stated) for x in LEVELS}
    level = min(options, key=lambda x: options[x].rms_ev)
    best = options[level]
    if not best.rms_ev < BETTER * agreement.rms_ev:
        return []
    return [
        f"Read at a linear value of {level:g} instead of {pivot:g}, correlation is "
        f"{best.correlation:.3f}, slope {best.slope:.2f}, RMS {best.rms_ev:.2f} EV: the cameras "
        "did not only change exposure, they also moved other tones against it."
    ]


def _write(result: Calibration, out: Path, cfg: FitConfig) -> None:
    s, p = result.selection.solution, cfg.photometry
    views = result.scene.views
    write_solution(out / "photometry.json", s, views=views, pivot=p.pivot, known=p.known)
    write_json(
        out / "calibration.json",
        {
            "messages": result.messages,
            "observations": result.observations,
            "seconds": result.seconds,
            "solution": s.state,
            "residual_ev": s.residual_ev,
            "view_residual_ev": s.view_residual_ev,
            "view_balance_ev": s.view_balance_ev,
            "outliers": s.outliers,
            "component": s.component,
            "observations_per_view": s.observations_per_view,
            "agreement": result.agreement._asdict(),
            "candidates": [
                {
                    "model": c.model,
                    "curve": c.response.name,
                    "parameters": c.parameters,
                    "density": c.density,
                    "behind": c.behind,
                    "behind_error": c.behind_error,
                    "codes": c.codes,
                }
                for c in result.selection.candidates
            ],
        },
    )
    write_calibration_plot(
        out / "calibration.png",
        s,
        cameras=[v.camera for v in views],
        stated_ev=result.stated_ev,
        pivot=p.pivot,
    )
