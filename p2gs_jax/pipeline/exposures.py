"""Exposures before the first step.

Colours of shared points are sampled from the photographs. Model and curve are chosen and solved
from these colours. Where no points are shared, exposures start at 1 and are learned.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from p2gs_jax.config import FitConfig
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.errors import UserError
from p2gs_jax.photometry import calibrate
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.parameters import initial_photometry
from p2gs_jax.photometry.sources.points import has_tracks, surface_colors
from p2gs_jax.run.decisions import Decisions, decide
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Photometry, Scene


@dataclass(frozen=True)
class Exposures:
    """Photometry of a scene's photographs before the first step."""

    photometry: Photometry  # initial parameters of the training views
    decisions: Decisions  # values that the scene decided
    observations: Observations | None = None  # colours of shared points, or None
    # model, exposures and their errors, or None if nothing was solved here
    selection: calibrate.Selection | None = None
    # linear radiance of the scene's points; None: it follows from the selection
    radiance: Float32[np.ndarray, "p 3"] | None = None
    notes: tuple[str, ...] = ()  # notes for the user

    @property
    def solved(self) -> bool:
        """Whether exposures were solved, for this scene or for a larger one that contains it."""
        return self.selection is not None or self.radiance is not None


def solve_exposures(
    scene: Scene,
    still: ImageStore,
    cfg: FitConfig,
    reporter: Reporter | None = None,
    *,
    on_chosen: calibrate.OnChosen = lambda form, response: None,
    dense: bool = False,
    kept: Decisions | None = None,
) -> Exposures:
    """Sample colours of shared points, and solve the photometry from them, where possible.

    `still` has the photographs without moving objects and transparent pixels. `on_chosen` receives
    model and curve before they are solved; a resumed run keeps those of its checkpoints (`kept`).
    With `dense`, observations are sampled even if the fit does not start from solved exposures.
    """
    found, notes = _sampled(scene, still, cfg, reporter or Silent(), dense=dense)
    selection, options = None, cfg if kept is None else kept.resolve(cfg)
    if found is not None and len(found.points) and cfg.photometry.start == "tracks":
        (reporter or Silent()).stage("Photometric bundle adjustment")
        selection = calibrate.calibrate_observations(
            found, calibrate.options_of(options, scene), on_chosen
        )
        if kept is not None:
            selection = dataclasses.replace(selection, reasons=kept.reasons)
        notes += [*selection.reasons, *selection.solution.warnings]
    elif cfg.photometry.known is not None:
        unseen = "no point is seen by two photographs"
        why = f"{scene.root}: {'seed points are random' if scene.random_seeds else unseen}, so "
        why += "--known-exposures give no radiance."
        raise UserError(why, fix="leave the option out, or give a structure-from-motion model")
    decisions = decide(cfg, selection, kept)
    resolved = decisions.resolve(cfg)
    solution = None if selection is None else selection.solution
    cameras = [view.camera for view in scene.training_views]
    photometry = initial_photometry(solution, cameras, resolved)
    return Exposures(photometry, decisions, found, selection, notes=tuple(notes))


def _sampled(
    scene: Scene, still: ImageStore, cfg: FitConfig, reporter: Reporter, *, dense: bool
) -> tuple[Observations | None, list[str]]:
    """Return colours of shared points (None: unneeded, or seeds are random), and notes."""
    from_tracks, notes = cfg.photometry.start == "tracks", []
    if not (has_tracks(scene) or from_tracks or dense):
        return None, []
    if scene.random_seeds:
        note = "Random seeds do not lie on surfaces: exposures start at 1 and are learned."
        return None, [note] if from_tracks else []
    if not has_tracks(scene):
        notes.append("No tracks: seed points are projected into the views instead.")
    found = surface_colors(
        scene, still, cfg.train.seed, lambda i, n: reporter.stage("Sampling colours", i, n)
    )
    if from_tracks and not len(found.points):
        notes.append(
            "No point is visible in two views: exposures start at 1 and are learned from step 1."
        )
    return found, notes
