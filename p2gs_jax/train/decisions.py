"""What a fit decided before its first step, as its checkpoints remember it.

Model and curve are chosen from the photographs, in numpy and threads: another machine may break a
near tie the other way, and a state that was optimised under one curve means little under another.
So a resumed run keeps what its checkpoints say.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import plain
from p2gs_jax.errors import UserError
from p2gs_jax.run.checkpoint import CheckpointStore

KEY = "decided"


def decisions(cfg: FitConfig) -> dict[str, Any]:
    """Return, as plain values, what a configuration says that the scene decides, not the user."""
    p, o = cfg.photometry, cfg.optimizer
    values = {
        "model": p.model,
        "curve": p.curve,
        "spline": p.spline,
        "freeze_until": p.freeze_until,
        "correspondence": cfg.loss.relative_exposure.correspondence,
        "log_exposure_mean": cfg.loss.regularizers.log_exposure_mean,
        "exposure_rate": o.exposures,
        "gamma_rate": o.gammas,
    }
    return plain(values)


def recorded(cfg: FitConfig, reasons: Sequence[str]) -> dict[str, Any]:
    """Return what a checkpoint remembers.

    Args:
        cfg: what the run is optimised under.
        reasons: for the model and the curve, in words.
    """
    return {**decisions(cfg), "reasons": list(reasons)}


def kept(cfg: FitConfig, run_dir: Path) -> tuple[FitConfig, tuple[str, ...]]:
    """Return the configuration under the model and curve of a run's checkpoints, and their reasons.

    Without checkpoints, or where nothing was to be chosen, it stays.

    Args:
        cfg: as the user gives it.
        run_dir: the run folder.
    """
    p = cfg.photometry
    if not (p.select and p.start == "tracks"):
        return cfg, ()
    saved = (CheckpointStore(run_dir / "checkpoints").latest_meta() or {}).get(KEY)
    if saved is None:
        return cfg, ()
    spline = saved["spline"]
    chosen = dataclasses.replace(
        p,
        select=False,
        model=saved["model"],
        curve=saved["curve"],
        spline=None if spline is None else tuple(spline),
    )
    return dataclasses.replace(cfg, photometry=chosen), tuple(saved["reasons"])


def check(saved: dict[str, Any] | None, cfg: FitConfig, folder: Path) -> None:
    """Refuse to continue a run whose scene decides otherwise than it did.

    Args:
        saved: from the checkpoint; None, as older versions wrote, is believed.
        cfg: what the run would be continued under.
        folder: of the checkpoints.

    Raises:
        UserError: a decision differs.
    """
    if saved is None:
        return
    now = decisions(cfg)
    other = [f"{k} was {saved.get(k)}, now {v}" for k, v in now.items() if saved.get(k) != v]
    if other:
        raise UserError(
            f"The checkpoints in {folder} were made under other decisions than this scene leads "
            f"to now: {'; '.join(other)}.",
            fix="restore the scene as it was when the run began, or start again in another folder "
            "with --out",
        )
