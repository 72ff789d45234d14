"""Comparison of a bench with the committed baseline."""

from __future__ import annotations

import json
from pathlib import Path

from p2gs_jax.bench.metrics import METRICS
from p2gs_jax.bench.speed_error import MeasuredVariant
from p2gs_jax.core.atomic import write_json
from p2gs_jax.errors import UserError

Rows = dict[str, dict[str, float]]


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


def check(path: Path, rows: Rows) -> list[str]:
    """Return one sentence for each value that is worse than the baseline allows.

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
                complaints.append(
                    f"{name}: {declared.title} ({metric}) is {value:.3g}, baseline {known:.3g}, "
                    f"tolerance {declared.tolerance:g}"
                )
    return complaints
