"""What a scene decides that the options leave open; everything else stays as it was asked."""

from __future__ import annotations

import dataclasses

from p2gs_jax.config import FitConfig
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.response import Response
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import KEY, Decisions
from p2gs_jax.run.folder import RunFolder

# Exposures that are learned from nothing move this many times faster (docs/photometry.md, 4).
FROM_NOTHING = 10.0


def decide(
    cfg: FitConfig, selection: Selection | None, *, matched: bool, kept: Decisions | None = None
) -> Decisions:
    """Return what the photographs decided.

    Args:
        cfg: as asked.
        selection: what the bundle adjustment chose and solved, or None.
        matched: there are colours of shared points.
        kept: from the checkpoints of a run that is resumed: what its cameras do stays to the digit.
    """
    decided = Decisions.as_asked(cfg)
    if selection is None:
        decided = unsolved(decided)
        return without_tracks(decided) if cfg.photometry.start == "tracks" else decided
    s = selection.solution
    form = Form(s.model, s.white_balance_level, s.vignetting)
    decided = with_choice(decided, form, s.response)
    decided = dataclasses.replace(
        decided,
        reasons=tuple(selection.reasons),
        cameras=s.cameras if kept is None else kept.cameras,
    )
    if cfg.photometry.known is None:
        return decided
    # Known exposures that are to be kept are not learned, and nothing pulls at their mean.
    keep = cfg.photometry.known_deviation_ev == 0
    return dataclasses.replace(
        decided,
        log_exposure_mean=None,
        freeze_until=1.0 if keep else decided.freeze_until,
    )


def likely(cfg: FitConfig, kept: Decisions | None, *, matched: bool) -> Decisions | None:
    """Return what most scenes decide, to compile for it beforehand; None: who knows.

    Args:
        cfg: as asked.
        kept: from the checkpoints of a run that is resumed, or None.
        matched: colours of shared points will be there.
    """
    p, d = cfg.photometry, cfg.densify
    slots_known = d.method == "mcmc"
    if p.known is not None or cfg.loss.relative_exposure.weight is not None or not slots_known:
        return None
    # What cameras do enters the programs, and is not solved yet.
    solved = p.start == "tracks" and (p.vignetting is not None or p.responses != "all")
    if kept is None and not p.select and solved:
        return None
    decided = Decisions.as_asked(cfg)
    if kept is not None:
        chosen = ("model", "curve", "spline", "white_balance", "vignetting", "responses", "cameras")
        decided = dataclasses.replace(decided, **{name: getattr(kept, name) for name in chosen})
    elif p.start != "tracks":
        decided = unsolved(decided)
    elif p.select:
        decided = dataclasses.replace(
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
        decided,
        white_balance="view" if by_view else None,
        vignetting=None,
        responses="all",
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
    """Return what the checkpoints of a run remember; None: nothing was found, or there are none.

    Args:
        cfg: as asked.
        folder: of the run.
    """
    p = cfg.photometry
    solved = p.vignetting is not None or p.responses != "all"
    if not ((p.select or solved) and p.start == "tracks"):
        return None
    saved = (CheckpointStore(folder.checkpoints).latest_meta() or {}).get(KEY)
    return None if saved is None else Decisions.from_dict(saved)
