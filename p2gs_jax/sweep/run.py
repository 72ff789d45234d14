"""Fits of one scene under many configurations: in processes, resumable, into one table."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig, to_dict
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.errors import UserError
from p2gs_jax.pipeline.preflight import check_run_dir
from p2gs_jax.run.lock import locked
from p2gs_jax.sweep.processes import Processes
from p2gs_jax.sweep.rows import read_row, to_markdown
from p2gs_jax.sweep.worker import REASON

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


def slug(name: str) -> str:
    """Return a folder name for a configuration's name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", name).strip("_.") or "_"


def sweep(
    scene: str | Path,
    out: str | Path,
    configs: Mapping[str, FitConfig],
    *,
    seeds: Sequence[int] = (0,),
    reference: str | Path | None = None,
    max_parallel: int = 1,
    report: Callable[[str], None] = lambda line: None,
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
        max_parallel: processes at a time; one uses all cores.
        report: receives a line per run.

    Raises:
        UserError: nothing to do, names that would share a folder, a folder of other options, or
            one that another sweep is writing to.
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
    out.mkdir(parents=True, exist_ok=True)
    jobs = []
    for name, cfg in configs.items():
        for seed in seeds:
            seeded = dataclasses.replace(cfg, train=dataclasses.replace(cfg.train, seed=seed))
            run = out / slug(name) / f"seed_{seed}"
            check_run_dir(run, True, seeded)
            jobs.append({"name": name, "seed": seed, "run": run, "cfg": seeded})
    rows: list[dict[str, Any]] = [
        {"name": j["name"], "seed": j["seed"], "run": str(j["run"]), "status": "waiting"}
        for j in jobs
    ]

    processes, writing = Processes(), threading.Lock()

    def one(k: int) -> None:
        begin = time.monotonic()
        job, kept = jobs[k], (jobs[k]["run"] / "metrics.json").exists()
        if not kept:
            job_path = out / JOBS / f"{slug(job['name'])}_{job['seed']}.json"
            _run(job, scene, reference, job_path, processes)
        found = _outcome(job["run"], scene, stopped=processes.stopped)
        if found["status"] == "done":
            said = "kept" if kept else f"{found.get('seconds', time.monotonic() - begin):.0f} s"
        else:
            said = f"{found['status']}: {found['reason']}"
        with writing:  # others write the same table
            rows[k].update(found)
            report(f"[{k + 1}/{len(jobs)}] {job['name']}, seed {job['seed']}: {said}")
            _write_table(out, rows)

    with locked(out), ThreadPoolExecutor(max_parallel) as pool:
        try:
            list(pool.map(one, range(len(jobs))))
        except BaseException:
            processes.stop()
            raise
    return SweepResult(rows, out)


def _outcome(run: Path, scene: Path, *, stopped: bool) -> dict[str, Any]:
    """Return the status of a run that has ended, with its columns or the reason."""
    if not (run / "metrics.json").exists():
        if stopped and not (run / REASON).exists():
            return {"status": "interrupted", "reason": "the same sweep continues it"}
        return {"status": "failed", "reason": _reason(run)}
    try:
        return {"status": "done", **read_row(run, scene)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"its files cannot be read ({error}): remove {run} and repeat"
        return {"status": "failed", "reason": reason}


def _write_table(out: Path, rows: list[dict[str, Any]]) -> None:
    write_json(out / TABLE, rows)
    write_text(out / TABLE_TEXT, to_markdown(rows))


def _run(job: dict[str, Any], scene: Path, reference, job_path: Path, processes: Processes) -> None:
    """Run one fit in a process of its own and wait for it."""
    run: Path = job["run"]
    run.mkdir(parents=True, exist_ok=True)
    (run / REASON).unlink(missing_ok=True)  # of an earlier try
    write_json(
        job_path,
        {
            "scene": str(scene.absolute()),
            "run": str(run.absolute()),
            "reference": None if reference is None else str(Path(reference).absolute()),
            "fit": to_dict(job["cfg"]),
        },
    )
    failed = processes.run([sys.executable, "-m", "p2gs_jax.sweep.worker", str(job_path)])
    if failed is not None and not (run / REASON).exists():
        write_json(run / REASON, {"reason": failed})


def _reason(run: Path) -> str:
    try:
        return json.loads((run / REASON).read_text(encoding="utf-8"))["reason"]
    except (OSError, ValueError, KeyError):
        return "it left no metrics.json and no reason"
