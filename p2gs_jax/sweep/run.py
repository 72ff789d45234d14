"""Fits of one scene under many configurations: in processes, resumable, into one table."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.errors import UserError
from p2gs_jax.jobs.engines import (
    LOCAL,
    check_engine,
    open_engine,
)
from p2gs_jax.jobs.job import (
    Job,
    JobState,
    read_reason,
    slug,
)
from p2gs_jax.jobs.run import (
    run_jobs,
)
from p2gs_jax.pipeline.preflight import check_run_dir
from p2gs_jax.run.lock import locked
from p2gs_jax.sweep.rows import read_row, to_markdown
from p2gs_jax.sweep.task import fit_job

TABLE, TABLE_TEXT, JOBS = "sweep.json", "sweep.md", "jobs"


@dataclass(frozen=True)
class SweepResult:
    """Result of a sweep.

    Attributes:
        rows: one dict per configuration and seed: name, seed, status (`done` or `failed`; in the
            table of a sweep that was stopped also `waiting` and `interrupted`), run, the reason of
            a failure, and the columns of `rows.COLUMNS` that the run has.
        out: the folder, with sweep.json and sweep.md.
    """

    rows: list[dict[str, Any]]
    out: Path

    def to_markdown(self) -> str:
        """Return the table, means over seeds."""
        return to_markdown(self.rows)


def sweep(
    scene: str | Path,
    out: str | Path,
    configs: Mapping[str, FitConfig],
    *,
    seeds: Sequence[int] = (0,),
    reference: str | Path | None = None,
    max_parallel: int = 1,
    engine: str = LOCAL,
    report: Callable[[str], None] = lambda line: None,
    on_look: Callable[[Sequence[JobState]], None] = lambda states: None,
) -> SweepResult:
    """Fit a scene under every configuration and seed.

    Finished runs in `out` are kept, interrupted ones continue, failed ones are tried again; a
    failure ends its run, not the sweep. The table is written anew after every run.

    Args:
        scene: see `fit`.
        out: folder of the runs and the table.
        configs: by name.
        seeds: each replaces `train.seed`.
        reference: see `fit`.
        max_parallel: processes at a time; steps of one hardly use more than one core (BUILD_NOTES).
        engine: where they run (`jobs.engines.open_engine`): local, dask://HOST:PORT or slurm.
        report: receives a line per run.
        on_look: receives how far the unfinished runs are, twice a second.

    Raises:
        UserError: nothing to do, names that would share a folder, a folder of other options, one
            that another sweep is writing to, or an engine that is not there.
        Interrupted: a signal asked for the end; the runs under way write their checkpoints first.
    """
    scene, out = Path(scene), Path(out)
    if not configs or not seeds:
        raise UserError(
            "a sweep needs at least one configuration and one seed.",
            fix="see docs/sweeps.md for an example",
        )
    if max_parallel < 1:
        raise UserError(f"max_parallel is {max_parallel}.", fix="let at least 1 run at a time")
    folders = [slug(name) for name in configs]
    if len(set(folders)) < len(folders):
        twice = sorted({f for f in folders if folders.count(f) > 1})
        raise UserError(
            f"several configurations would share the folder {', '.join(twice)}.",
            fix="give them names that differ in letters or digits",
        )
    check_engine(engine)
    out.mkdir(parents=True, exist_ok=True)
    truth = None if reference is None else Path(reference)
    jobs: list[Job] = []
    rows: list[dict[str, Any]] = []
    for name, cfg in configs.items():
        for seed in seeds:
            seeded = dataclasses.replace(cfg, train=dataclasses.replace(cfg.train, seed=seed))
            run = out / slug(name) / f"seed_{seed}"
            check_run_dir(run, True, seeded)
            jobs.append(fit_job(f"{name}, seed {seed}", scene, run, seeded, truth))
            rows.append({"name": name, "seed": seed, "run": str(run), "status": "waiting"})

    def tell(number: int, state: JobState | None) -> None:
        """Note what became of a run; None: it was there before."""
        row = rows[number]
        row.update(_outcome(jobs[number].folder, scene, state))
        if row["status"] == "done":
            took = 0.0 if state is None else state.seconds
            said = "kept" if state is None else f"{row.get('seconds', took):.0f} s"
        else:
            said = f"{row['status']}: {row['reason']}"
        report(f"[{number + 1}/{len(jobs)}] {jobs[number].name}: {said}")
        _write_table(out, rows)

    with locked(out):
        left = []
        for number, job in enumerate(jobs):
            if (job.folder / "metrics.json").exists():
                tell(number, None)
            else:
                left.append(number)
        if left:
            with open_engine(engine, max_parallel, out / JOBS) as workers:
                run_jobs(
                    [jobs[number] for number in left],
                    workers,
                    out / JOBS,
                    on_end=lambda k, state: tell(left[k], state),
                    on_look=on_look,
                )
    return SweepResult(rows, out)


def _outcome(run: Path, scene: Path, state: JobState | None) -> dict[str, Any]:
    """Return the status of a run that has ended, with its columns or the reason."""
    if state is not None and state.status == "stopped":
        return {"status": "interrupted", "reason": "the same sweep continues it"}
    if not (run / "metrics.json").exists():
        return {"status": "failed", "reason": (state and state.reason) or read_reason(run)}
    try:
        return {"status": "done", **read_row(run, scene)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"its files cannot be read ({error}): remove {run} and repeat"
        return {"status": "failed", "reason": reason}


def _write_table(out: Path, rows: list[dict[str, Any]]) -> None:
    write_json(out / TABLE, rows)
    write_text(out / TABLE_TEXT, to_markdown(rows))
