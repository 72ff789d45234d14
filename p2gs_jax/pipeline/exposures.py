"""Exposures before the first step, and what a scene decides that the options leave open.

Colours of shared points are sampled from the photographs, model and curve are chosen and solved
from them; where nothing is shared, exposures start at 1 and are learned.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from p2gs_jax.config import FitConfig
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.photometry import calibrate
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.parameters import initial_photometry
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.sources.points import has_tracks, surface_colors
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import KEY, Decisions
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Photometry, Scene

# Exposures that are learned from nothing move this many times faster (docs/photometry.md, 4).
FROM_NOTHING = 10.0


@dataclass(frozen=True)
class Exposures:
    """What is known of the light of a scene's photographs before the first step."""

    photometry: Photometry  # parameters of the training views to start from
    decisions: Decisions  # what the scene settled
    observations: Observations | None = None  # colours of shared points, or None
    # model, exposures and their errors, or None where nothing was solved here
    selection: calibrate.Selection | None = None
    # linear, of the scene's points; None: it follows from the selection
    radiance: Float32[np.ndarray, "p 3"] | None = None
    notes: tuple[str, ...] = ()  # what the user should know

    @property
    def solved(self) -> bool:
        """Whether exposures are known, here or for a whole of which the scene is a part."""
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
    """Sample colours of shared points, and solve the photometry from them; both where possible.

    Photographs are those of what stands `still` and is opaque. `on_chosen` receives model and curve
    before they are solved; those that the checkpoints of a resumed run `kept` stay. With `dense`,
    observations are wanted even where the fit starts from no exposures.
    """
    found, notes = _sampled(scene, still, cfg, reporter or Silent(), dense=dense)
    selection, under = None, cfg if kept is None else kept.resolve(cfg)
    if found is not None and len(found.points) and cfg.photometry.start == "tracks":
        (reporter or Silent()).stage("Photometric bundle adjustment")
        selection = calibrate.calibrate_observations(
            found, calibrate.options_of(under, scene), on_chosen
        )
        if kept is not None:
            selection = dataclasses.replace(selection, reasons=kept.reasons)
        notes += [*selection.reasons, *selection.solution.warnings]
    decisions = decide(cfg, selection, kept=kept)
    resolved = decisions.resolve(cfg)
    solution = None if selection is None else selection.solution
    taken_by = [view.camera for view in scene.training_views]
    photometry = initial_photometry(solution, taken_by, resolved)
    return Exposures(photometry, decisions, found, selection, notes=tuple(notes))


def _sampled(
    scene: Scene, still: ImageStore, cfg: FitConfig, reporter: Reporter, *, dense: bool
) -> tuple[Observations | None, list[str]]:
    """Return colours of shared points, where they are wanted, and what the user should know."""
    from_tracks, notes = cfg.photometry.start == "tracks", []
    if not (has_tracks(scene) or from_tracks or dense):
        return None, []
    if scene.random_seeds:
        note = "Seeds at random show nothing twice: exposures start at 1 and are learned."
        return None, [note] if from_tracks else []
    if not has_tracks(scene):
        notes.append("No tracks: seed points are projected into the views instead.")
    found = surface_colors(
        scene, still, cfg.train.seed, lambda i, n: reporter.stage("Sampling colours", i, n)
    )
    if from_tracks and not len(found.points):
        notes.append(
            "No point is seen twice: exposures start at 1 and are learned from the first step."
        )
    return found, notes


def decide(
    cfg: FitConfig, selection: calibrate.Selection | None, *, kept: Decisions | None = None
) -> Decisions:
    """Return what the photographs decided.

    Where the checkpoints of a run that is resumed are `kept`, what its cameras do stays to the
    digit.
    """
    decided = Decisions.as_asked(cfg)
    if selection is None:
        decided = unsolved(decided)
        return without_tracks(decided) if cfg.photometry.start == "tracks" else decided
    s = selection.solution
    form = Form(s.model, s.white_balance_level, s.vignetting)
    decided = dataclasses.replace(
        with_choice(decided, form, s.response),
        reasons=tuple(selection.reasons),
        cameras=s.cameras if kept is None else kept.cameras,
    )
    if cfg.photometry.known is None:
        return decided
    # Known exposures that are to be kept are not learned, and nothing pulls at their mean.
    keep = cfg.photometry.known_deviation_ev == 0
    return dataclasses.replace(
        decided, log_exposure_mean=None, freeze_until=1.0 if keep else decided.freeze_until
    )


def likely(cfg: FitConfig, kept: Decisions | None, near: float | None = None) -> Decisions | None:
    """Return what most scenes decide, to compile for it beforehand; None: who knows.

    `near` is the near plane, where that is decided.
    """
    p, relative = cfg.photometry, cfg.loss.relative_exposure
    if p.known is not None or relative.weight is not None or cfg.densify.method != "mcmc":
        return None
    # What cameras do enters the programs, and is not solved yet.
    solved = p.start == "tracks" and (p.vignetting is not None or p.responses != "all")
    if kept is None and not p.select and solved:
        return None
    decided = dataclasses.replace(Decisions.as_asked(cfg), near=near)
    if kept is not None:
        chosen = ("model", "curve", "spline", "white_balance", "vignetting", "responses", "cameras")
        return dataclasses.replace(decided, **{name: getattr(kept, name) for name in chosen})
    if p.start != "tracks":
        return unsolved(decided)
    if p.select:
        return dataclasses.replace(
            decided, model="view_exposure", white_balance=None, vignetting=None, responses="all"
        )
    return decided


def with_choice(decided: Decisions, form: Form, response: Response) -> Decisions:
    """Return the decisions under a form and a curve; what cameras do follows from the solution."""
    return dataclasses.replace(
        decided,
        model=form.model,
        curve=response.curve,
        spline=response.spline,
        white_balance=form.white_balance,
        vignetting=form.vignetting,
        responses=response.by,
    )


def unsolved(decided: Decisions) -> Decisions:
    """Return the decisions without what only a solution can give; views may still learn theirs."""
    by_view = decided.white_balance == "view"
    return dataclasses.replace(
        decided, white_balance="view" if by_view else None, vignetting=None, responses="all"
    )


def without_tracks(decided: Decisions) -> Decisions:
    """Return the decisions for exposures learned from nothing: from the first step, and fast."""
    return dataclasses.replace(
        decided,
        freeze_until=0.0,
        exposure_rate=FROM_NOTHING * decided.exposure_rate,
        gamma_rate=FROM_NOTHING * decided.gamma_rate,
    )


def kept_choice(cfg: FitConfig, folder: RunFolder) -> Decisions | None:
    """Return what the checkpoints of a run remember; None: nothing was found, or there are none."""
    p = cfg.photometry
    solved = p.vignetting is not None or p.responses != "all"
    if not ((p.select or solved) and p.start == "tracks"):
        return None
    saved = (CheckpointStore(folder.checkpoints).latest_meta() or {}).get(KEY)
    return None if saved is None else Decisions.from_dict(saved)
