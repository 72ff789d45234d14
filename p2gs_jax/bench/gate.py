"""Comparison of a bench with the committed baseline."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from p2gs_jax.bench.metrics import METRICS
from p2gs_jax.bench.speed_error import MeasuredVariant
from p2gs_jax.core.atomic import write_json
from p2gs_jax.errors import UserError

Rows = dict[str, dict[str, float]]
# How often times that seem worse are measured again.
AGAIN = 2


class Complaint(NamedTuple):
    """A value that is worse than the baseline allows.

    Attributes:
        row: variant or scene.
        metric: which of its values.
        timed: whether it is a time.
        text: one sentence for a person.
    """

    row: str
    metric: str
    timed: bool
    text: str


def values(points: list[MeasuredVariant]) -> Rows:
    """Return per variant what the gate compares.

    The total error includes the rules' cutoffs; `numerics ...` is the implementation's own error.
    """
    rows = {}
    for p in points:
        row = {**p.error, **p.ratios}
        row |= {f"numerics {k}": v for k, v in (p.numerics or {}).items()}
        rows[p.variant.name] = row
    return rows


def write_baseline(path: Path, rows: Rows) -> None:
    """Write the baseline that `check` reads; rows of the file that were not measured stay."""
    known = json.loads(path.read_text()) if path.is_file() else {}
    write_json(path, known | rows)


def check(path: Path, rows: Rows) -> list[Complaint]:
    """Return a complaint for each value that is worse than the baseline allows.

    Args:
        path: the baseline.
        rows: variant or scene -> metric -> value.

    Raises:
        UserError: the baseline is missing, damaged, or lacks a variant or metric.
    """
    try:
        baseline = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} is no baseline: {error}", fix="write one with --write-baseline"
        ) from error
    complaints = []
    for name, row in rows.items():
        for metric, value in row.items():
            known = baseline.get(name, {}).get(metric)
            if not isinstance(known, int | float):
                raise UserError(
                    f"{path} has no {metric!r} of {name!r}", fix="write it anew: --write-baseline"
                )
            declared = METRICS[metric.removeprefix("numerics ")]
            if declared.worse(value, known):
                text = (
                    f"{name}: {declared.title} ({metric}) is {value:.3g}, baseline {known:.3g}, "
                    f"tolerance {declared.tolerance:g}"
                )
                complaints.append(Complaint(name, metric, declared.timed, text))
    return complaints


def settle(
    path: Path, rows: Rows, measure: Callable[[list[str]], Rows], again: int = AGAIN
) -> list[str]:
    """Return one sentence for each value that is worse, times only where they stay so.

    Whatever else runs on a machine makes times longer, never shorter: rows whose times are worse
    are measured again, and the least of all measurements counts. Accuracy counts as it was
    measured first.

    Args:
        path: the baseline.
        rows: as for `check`.
        measure: returns the rows of these names, measured anew.
        again: how often at most.

    Raises:
        UserError: as `check`.
    """
    complaints = check(path, rows)
    for _ in range(again):
        slow = [c for c in complaints if c.timed]
        if not slow:
            break
        fresh = measure(list(dict.fromkeys(c.row for c in slow)))
        rows = {name: dict(row) for name, row in rows.items()}
        for c in slow:
            rows[c.row][c.metric] = min(rows[c.row][c.metric], fresh[c.row][c.metric])
        complaints = check(path, rows)
    return [c.text for c in complaints]
