"""One fit of a sweep, as a job."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig, from_dict, to_dict
from p2gs_jax.core.compile_cache import use_compile_cache
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.runtime import tune_process
from p2gs_jax.jobs.job import (
    Job,
)
from p2gs_jax.pipeline.fit import fit
from p2gs_jax.run.layout import RunFolder


def fit_job(name: str, scene: Path, run: Path, cfg: FitConfig, reference: Path | None) -> Job:
    """Return the job of a fit.

    Args:
        name: of the job.
        scene: see `fit`.
        run: run folder; what it holds is continued.
        cfg: options.
        reference: see `fit`.
    """
    said = {
        "scene": str(scene.absolute()),
        "reference": None if reference is None else str(reference.absolute()),
        "fit": to_dict(cfg),
    }
    return Job(name, run, fit_task, said)


def fit_task(folder: Path, arguments: dict[str, Any], reporter: Reporter) -> None:
    """Fit, or go on with a fit.

    Args:
        folder: of the run.
        arguments: of a `fit_job`.
        reporter: receives progress.

    Raises:
        UserError: see `fit`.
    """
    use_compile_cache()
    tune_process()
    fit(
        arguments["scene"],
        folder,
        from_dict(arguments["fit"]),
        reference=arguments["reference"],
        resume=RunFolder(folder).config.exists(),
        reporter=reporter,
        # As for `p2gs-jax fit`: starting the interpreter counts.
        spent_s=time.process_time(),
    )
