"""Sweeps: resumable fits of one scene with many configurations, in processes, with one table."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.core.clock import whole_run
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.runtime import tune_process, use_compile_cache
from p2gs_jax.core.text import escaped, markdown_table, parse_json, value_at
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.alignment import true_error
from p2gs_jax.evaluation.scores import PROTOCOLS
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.jobs.engines import LOCAL, check_engine, open_engine
from p2gs_jax.jobs.job import Job, JobState, read_reason, slug
from p2gs_jax.jobs.run import Runner, run_jobs
from p2gs_jax.jobs.worker import run_in_process
from p2gs_jax.pipeline.fit import fit
from p2gs_jax.pipeline.preflight import Paths, check_run_dir, preflight
from p2gs_jax.presets import from_dict, to_dict
from p2gs_jax.run.folder import RunFolder, locked, require_folder
from p2gs_jax.run.read import read_config, require_as_begun
from p2gs_jax.run.scene_file import read_scene

TABLE, TABLE_TEXT, JOBS = "sweep.json", "sweep.md", "jobs"


@dataclass(frozen=True)
class SweepResult:
    """The result of a sweep: one row per configuration and seed.

    Rows have name, seed, status, run, the reason of a failure, and the `COLUMNS` of the run. The
    status is `done` or `failed`, and in the table of a stopped sweep `waiting` or `interrupted`.
    """

    rows: list[dict[str, Any]]
    out: Path  # the folder, with sweep.json and sweep.md

    def to_markdown(self) -> str:
        """Return the table with means over seeds."""
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
    run: Runner = run_in_process,
) -> SweepResult:
    """Fit a scene with every configuration and seed.

    Finished runs in `out` are kept, or evaluated again under other options of the evaluation.
    Interrupted ones continue, and failed ones are tried again. A failure ends its run, but not the
    sweep. The table is written after every run.

    Each of `seeds` replaces `train.seed`. `max_parallel` processes run at a time; on one
    machine they share its cores. The engine is one of `jobs.engines.open_engine`. `report` receives
    a line per run. `on_look` and `run` are as for `run_jobs`.

    Raises:
        UserError: there is nothing to do, names or seeds share a folder, options are not valid, a
            folder has other options or photographs, `out` is a file or another sweep writes to it,
            or the engine does not exist.
        Interrupted: a signal arrived; running fits write their checkpoints first.
    """
    scene, out = Path(scene), Path(out)
    _check(configs, seeds, max_parallel)
    check_engine(engine)
    require_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    jobs, rows, left = _planned(scene, out, configs, seeds, reference)

    def record(number: int, state: JobState | None) -> None:
        """Record the result of a run; None: the run was finished before."""
        row = rows[number]
        row.update(_outcome(jobs[number].folder, scene, state))
        duration = "kept" if state is None else f"{row.get('seconds', state.seconds):.0f} s"
        text = duration if row["status"] == "done" else f"{row['status']}: {row['reason']}"
        report(f"[{number + 1}/{len(jobs)}] {jobs[number].name}: {text}")
        write_json(out / TABLE, rows)
        write_text(out / TABLE_TEXT, to_markdown(rows))

    with locked(out):
        for number in sorted({*range(len(jobs))} - {*left}):
            record(number, None)
        if left:
            with open_engine(engine, max_parallel, out / JOBS) as workers:
                run_jobs(
                    [jobs[number] for number in left],
                    workers,
                    out / JOBS,
                    on_end=lambda k, state: record(left[k], state),
                    on_look=on_look,
                    run=run,
                )
    return SweepResult(rows, out)


def _planned(
    scene: Path,
    out: Path,
    configs: Mapping[str, FitConfig],
    seeds: Sequence[int],
    reference: str | Path | None,
) -> tuple[list[Job], list[dict[str, Any]], list[int]]:
    """Return the jobs of all configurations and seeds, the first cells of their rows, and the
    numbers of those that are not finished."""
    jobs, rows, left = [], [], []
    truth = None if reference is None else str(Path(reference).absolute())
    for name, cfg in configs.items():
        for seed in seeds:
            seeded = with_fields(cfg, {"train.seed": seed})
            folder = out / slug(name) / f"seed_{seed}"
            try:
                preflight(seeded, Paths.of(scene, folder, reference), resume=True)
                if not _is_finished(folder, scene, seeded):
                    left.append(len(jobs))
            except UserError as error:
                raise UserError(f"{name}: {error.message}", fix=error.fix) from error
            arguments = {"scene": str(scene.absolute()), "reference": truth, "fit": to_dict(seeded)}
            jobs.append(Job(f"{name}, seed {seed}", folder, fit_task, arguments))
            rows.append({"name": name, "seed": seed, "run": str(folder), "status": "waiting"})
    return jobs, rows, left


def _is_finished(folder: Path, scene: Path, cfg: FitConfig) -> bool:
    """Return whether a run has the steps, the time and the evaluation that its options ask for.

    UserError: its photographs were replaced since it began.
    """
    files = RunFolder(folder)
    if check_run_dir(folder, True, cfg) or not (files.config.exists() and files.metrics.exists()):
        return False
    require_as_begun(folder, read_scene(folder, scene), cfg)
    return read_config(files.config)[1].evaluation == cfg.evaluation


def _check(configs: Mapping[str, FitConfig], seeds: Sequence[int], max_parallel: int) -> None:
    if not configs or not seeds:
        fix = "see docs/api.md for an example"
        raise UserError("a sweep needs at least one configuration and one seed.", fix=fix)
    if min(seeds) < 0:
        raise UserError(f"a sweep has the seed {min(seeds)}.", fix="use whole numbers from 0 on")
    if len(set(seeds)) < len(seeds):
        why = f"a sweep has a seed twice ({', '.join(map(str, seeds))}); both runs would be one."
        raise UserError(why, fix="name every seed once")
    if max_parallel < 1:
        raise UserError(f"max_parallel = {max_parallel} is too small.", fix="use at least 1")
    folders = [slug(name) for name in configs]
    if len(set(folders)) < len(folders):
        twice = sorted({f for f in folders if folders.count(f) > 1})
        why = f"several configurations would share the folder {', '.join(twice)}."
        raise UserError(why, fix="give them names that differ in letters or digits")


def fit_task(folder: Path, arguments: dict[str, Any], reporter: Reporter) -> None:
    """Start or continue a fit with the arguments of a job; it raises the errors of `fit`."""
    use_compile_cache()
    tune_process()
    fit(
        arguments["scene"],
        folder,
        from_dict(arguments["fit"]),
        reference=arguments["reference"],
        resume=RunFolder(folder).config.exists(),
        reporter=reporter,
        # As in `p2gs-jax fit`, the budget includes the start of Python.
        spent_s=time.process_time(),
    )


def _outcome(run: Path, scene: Path, state: JobState | None) -> dict[str, Any]:
    """Return the status of an ended run, with its columns or the reason of its failure."""
    if state is not None and state.status == "stopped":
        return {"status": "interrupted", "reason": "the same sweep continues it"}
    # A continuation that failed leaves the scores of the shorter run.
    failed = state is not None and state.status == "failed"
    if failed or not RunFolder(run).metrics.exists():
        return {"status": "failed", "reason": (state and state.reason) or read_reason(run)}
    try:
        return {"status": "done", **read_row(run, scene)}
    except (UserError, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"its files cannot be read ({error}): remove {run} and repeat"
        return {"status": "failed", "reason": reason}


class Column(NamedTuple):
    """A column of the table."""

    name: str
    path: tuple[str, ...]  # keys in metrics.json; () for values that are computed
    digits: int  # after the decimal point
    heading: str = ""  # in the short table, which fits a terminal; "": not in it

    @property
    def meaning(self) -> str:
        """The meaning of the column in words."""
        for protocol in PROTOCOLS.values():
            if protocol.path == self.path[:-1]:
                return f"{protocol.views} views, {protocol.shown}"
        return MEANING.get(self.name, "")


COLUMNS = (
    Column("gaussians", ("counts", "gaussians"), 0, "Gaussians"),
    Column("steps", ("counts", "steps"), 0),
    Column("seconds", (), 0, "seconds"),
    Column("train_psnr", ("train", "psnr"), 2, "training PSNR dB"),
    Column("train_ssim", ("train", "ssim"), 4),
    Column("train_lpips", ("train", "lpips"), 4),
    Column("test_psnr_averaged", ("test", "averaged", "psnr"), 2),
    Column("test_lpips_averaged", ("test", "averaged", "lpips"), 4),
    Column("test_psnr_fitted", ("test", "exposure_fitted", "psnr"), 2, "held-out PSNR dB"),
    Column("test_psnr_all_fitted", ("test", "photometry_fitted", "psnr"), 2),
    Column("reference_psnr_averaged", ("reference", "averaged", "psnr"), 2),
    Column("reference_psnr", ("reference", "scale_aligned", "psnr"), 2, "reference PSNR dB"),
    Column("reference_lpips", ("reference", "scale_aligned", "lpips"), 4),
    Column("reference_test_psnr", ("reference", "scale_aligned", "test", "psnr"), 2),
    Column("reference_test_lpips", ("reference", "scale_aligned", "test", "lpips"), 4),
    Column("radiance_stops", ("radiance", "stops_rms"), 3),
    Column("ev", (), 4, "exposure error EV"),
    Column("ev_power", (), 4),
)
# Explanations of columns without a protocol.
MEANING = {
    "seconds": "duration of the whole run with compilation and evaluation, seconds",
    "radiance_stops": "RMS error of the radiance against the true HDR images, stops",
    "ev": "RMS error of the exposures against the true ones, stops, after one scale",
    "ev_power": "RMS error of the exposures, stops, after one scale and one power common to all",
}


def read_row(run: Path, scene: Path) -> dict[str, Any]:
    """Return the available columns of a finished run by name."""
    metrics = parse_json(RunFolder(run).metrics.read_text(encoding="utf-8"))
    row: dict[str, Any] = {}
    for column in COLUMNS:
        value = value_at(metrics, column.path)
        if column.path and value is not None:
            row[column.name] = value
    seconds = metrics.get("seconds")
    total = whole_run(seconds) if isinstance(seconds, Mapping) else None
    views = parse_json((run / "photometry.json").read_text(encoding="utf-8"))["views"]
    if (error := true_error(scene, views)) is not None:
        row |= {"ev": error["ev"], "ev_power": error["ev_scale_power"]}
    return row | ({} if total is None else {"seconds": total})


def brief(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return headings and cells of the most important columns, as means over seeds."""
    by_name = {column.name: column for column in COLUMNS if column.heading}
    shown = [by_name.pop("seconds"), *by_name.values()]
    shown = [column for column in shown if any(column.name in row for row in rows)]
    return ["configuration", "seeds", *(c.heading for c in shown)], _means(rows, shown)


def _means(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> list[list[str]]:
    """Return the cells of each configuration: name, number of finished seeds, means over these."""
    lines = []
    for name in dict.fromkeys(row["name"] for row in rows):
        runs = [row for row in rows if row["name"] == name]
        done = [row for row in runs if row["status"] == "done"]
        cells = []
        for column in columns:
            values = [row[column.name] for row in done if column.name in row]
            cells.append(f"{np.mean(values):.{column.digits}f}" if values else "-")
        lines.append([str(name), f"{len(done)} of {len(runs)}", *cells])
    return lines


def failures(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a line with the reason for every run that is not done."""
    return [
        f"{row['name']}, seed {row['seed']}: {row['status']}: {row.get('reason', '')}"
        for row in rows
        if row["status"] != "done"
    ]


def to_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a table with means over seeds per configuration, and the failures with reasons."""
    shown = [column for column in COLUMNS if any(column.name in row for row in rows)]
    names = ["configuration", "seeds", *(c.name for c in shown)]
    lines = [markdown_table(names, _means(rows, shown))]
    meanings = [f"- `{c.name}`: {c.meaning}" for c in shown if c.meaning]
    failed = [f"- {escaped(line)}" for line in failures(rows)]
    lines += ["", *meanings] if meanings else []
    lines += ["", "Not finished:", "", *failed] if failed else []
    return "\n".join(lines) + "\n"
