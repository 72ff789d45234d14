"""What a scene decides that the options leave open; everything else stays as it was asked."""

from __future__ import annotations

import dataclasses

from p2gs_jax.config import FitConfig
from p2gs_jax.photometry.models import ModelName
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.selection import Selection
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import KEY, Decisions
from p2gs_jax.run.layout import RunFolder

# Exposures that are learned from nothing move this many times faster (docs/photometry.md, 4).
FROM_NOTHING = 10.0


def decide(cfg: FitConfig, selection: Selection | None, *, matched: bool) -> Decisions:
    """Return what the photographs decided.

    Args:
        cfg: as asked.
        selection: what the bundle adjustment chose and solved, or None.
        matched: there are colours of shared points.
    """
    decided = with_correspondence(Decisions.as_asked(cfg), matched)
    if selection is None:
        return without_tracks(decided) if cfg.photometry.start == "tracks" else decided
    s = selection.solution
    decided = with_choice(decided, s.model, s.response)
    decided = dataclasses.replace(decided, reasons=tuple(selection.reasons))
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
    slots_known = d.method == "mcmc" and d.max_gaussians != "auto"
    if p.known is not None or cfg.loss.relative_exposure.weight is not None or not slots_known:
        return None
    decided = Decisions.as_asked(cfg)
    if kept is not None:
        decided = dataclasses.replace(
            decided, model=kept.model, curve=kept.curve, spline=kept.spline
        )
    elif p.start == "tracks" and p.select:
        decided = dataclasses.replace(decided, model="view_exposure")
    return with_correspondence(decided, matched or p.start == "tracks")


def with_choice(decided: Decisions, model: ModelName, response: Response) -> Decisions:
    """Return the decisions under a model and a curve."""
    return dataclasses.replace(decided, model=model, curve=response.curve, spline=response.spline)


def with_correspondence(decided: Decisions, matched: bool) -> Decisions:
    """Return the decisions with a way to compare photographs; one that was asked for stays."""
    if decided.correspondence is not None:
        return decided
    return dataclasses.replace(decided, correspondence="tracks" if matched else "depth")


def without_tracks(decided: Decisions) -> Decisions:
    """Return the decisions for exposures learned from nothing: from the first step, and fast."""
    return dataclasses.replace(
        decided,
        freeze_until=0.0,
        exposure_rate=FROM_NOTHING * decided.exposure_rate,
        gamma_rate=FROM_NOTHING * decided.gamma_rate,
    )


def kept_choice(cfg: FitConfig, folder: RunFolder) -> Decisions | None:
    """Return what the checkpoints of a run remember; None: nothing was chosen, or there are none.

    Args:
        cfg: as asked.
        folder: of the run.
    """
    p = cfg.photometry
    if not (p.select and p.start == "tracks"):
        return None
    saved = (CheckpointStore(folder.checkpoints).latest_meta() or {}).get(KEY)
    return None if saved is None else Decisions.from_dict(saved)
