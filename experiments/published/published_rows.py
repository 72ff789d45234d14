"""Rows of published benchmarks, written one by one, so that an interrupted call can continue.

`rows.json` beside this file holds what was measured. A row is told by its benchmark, scene, method
and steps; measured again, it replaces the old one.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from checkout import commit

from p2gs_jax.core.atomic import write_json

HERE = Path(__file__).parent
ROWS = HERE / "rows.json"


class Key(NamedTuple):
    """The measurement of a row."""

    benchmark: str  # as in `published.json`
    scene: str
    method: str  # preset, with what differs from it
    steps: int


def read_rows(path: Path = ROWS) -> dict[Key, dict[str, Any]]:
    """Return the measured rows; none if there is no file."""
    rows = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    return {Key(*(row[name] for name in Key._fields)): row for row in rows}


def add_row(key: Key, row: dict[str, Any], path: Path = ROWS) -> None:
    """Write a row to the others at once."""
    rows = read_rows(path) | {key: {**key._asdict(), **row}}
    write_json(path, [rows[k] for k in sorted(rows)])


class Fit(NamedTuple):
    """A finished fit."""

    metrics: dict[str, Any]  # as `metrics.json`
    commit: str  # of the checkout that fitted it; of one that was resumed by others, all


def of_fit(fit: Fit, command: str) -> dict[str, Any]:
    """Return the entries about the fit that every row has."""
    metrics = fit.metrics
    seconds = metrics["seconds"]
    # Of a resumed fit, "optimisation" is that of all its processes, all else of the last.
    last = sum(seconds.get(k, 0.0) for k in ("compiling", "steps", "densification", "checkpoints"))
    around = seconds["total_until_evaluation"] - last + seconds["evaluation_and_files"]
    return {
        "gaussians": metrics["counts"]["gaussians"],
        "seconds": round(around + seconds["optimisation"]),
        "seconds_of_steps": round(seconds["optimisation"]),
        "cores": len(os.sched_getaffinity(0)),
        "date": datetime.date.today().isoformat(),
        "commit": fit.commit,
        "command": command,
    }


def shown_seconds(row: Mapping[str, Any]) -> str:
    """Return the cell with a row's seconds; rows without a device had two cores or one."""
    device = "one core" if row.get("cores", 2) == 1 else row.get("device")
    return f"{row['seconds']} on {device}" if device else f"{row['seconds']}"


def fitted(scene: Path, run: Path, options: Sequence[str], again: bool = False) -> Fit:
    """Fit by the command line, or continue an interrupted fit.

    Args:
        scene: what is fitted.
        run: folder of the fit; beside it a file keeps the options and the commit that made it.
        options: of `p2gs-jax fit`.
        again: fit anew what is finished.

    Raises:
        SystemExit: the fit failed, or the folder holds one of other options.
    """
    found, record = run / "metrics.json", run.with_name(f"{run.name}.made.json")
    if again and found.is_file():
        shutil.rmtree(run)
    begun = (run / "config.json").is_file()
    made = {"options": [scene.name, *options], "commits": []}
    if begun:
        kept = json.loads(record.read_text(encoding="utf-8")) if record.is_file() else {}
        if kept.get("options") != made["options"]:
            raise SystemExit(
                f"{run} was not fitted with {' '.join(made['options'])}: remove that folder, or "
                "name another --out."
            )
        made = kept
    if not found.is_file():
        made["commits"] = list(dict.fromkeys([*made["commits"], commit()]))
        run.parent.mkdir(parents=True, exist_ok=True)
        write_json(record, made)
        resumed = ["--resume"] if begun else []
        words = ["fit", str(scene), "--out", str(run), *options, *resumed]
        done = subprocess.run([sys.executable, "-m", "p2gs_jax.cli", *words], check=False)
        if done.returncode:
            raise SystemExit(f"p2gs-jax {' '.join(words)} ended with {done.returncode}")
    metrics = json.loads(found.read_text(encoding="utf-8"))
    return Fit(metrics, ", then ".join(made["commits"]))


def measure(
    wanted: Sequence[Key],
    row_of: Callable[[Key], dict[str, Any]],
    again: bool = False,
    path: Path = ROWS,
) -> None:
    """Measure the missing rows one after another, and write each at once."""
    for key in wanted:
        if key in read_rows(path) and not again:
            print(f"{' '.join(map(str, key))}: there already", file=sys.stderr, flush=True)
            continue
        begin = time.monotonic()
        add_row(key, row_of(key), path)
        took = time.monotonic() - begin
        print(f"{' '.join(map(str, key))}: {took:.0f} s", file=sys.stderr, flush=True)


def options(
    description: str | None, name: str, methods: Iterable[str], steps: Sequence[int]
) -> argparse.ArgumentParser:
    """Return the options that all benchmarks have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("scenes", type=Path, nargs="+", help="scene folders")
    out = Path(tempfile.gettempdir(), f"published_{name}")
    parser.add_argument("--out", type=Path, default=out)
    parser.add_argument("--methods", nargs="+", default=list(methods))
    parser.add_argument("--steps", type=int, nargs="+", default=list(steps))
    parser.add_argument("--again", action="store_true", help="measure also what is there")
    return parser
