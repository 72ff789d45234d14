"""The gate: metrics with their tolerances, and their comparison with the committed baseline."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from p2gs_jax.core.atomic import write_json
from p2gs_jax.errors import UserError

# Values by variant or scene, and metric.
Rows = dict[str, dict[str, float]]
# Largest number of repeated measurements of times that are worse than the baseline.
AGAIN = 2


@dataclass(frozen=True)
class Metric:
    """One column of a table.

    Attributes:
        title: table heading, with the unit.
        better: whether lower or higher values are better.
        tolerance: the worst allowed difference from the baseline: a factor, or with `absolute` a
            number in the metric's unit.
        absolute: see `tolerance`.
        timed: whether it is a ratio of wall times, which other work on the machine changes.
    """

    title: str
    better: Literal["lower", "higher"]
    tolerance: float
    absolute: bool = False
    timed: bool = False

    def worse(self, value: float, baseline: float) -> bool:
        """Return whether `value` is worse than `baseline` allows; NaN always is worse."""
        sign = 1.0 if self.better == "lower" else -1.0
        limit = (
            baseline + sign * self.tolerance if self.absolute else baseline * self.tolerance**sign
        )
        return not sign * value <= sign * limit


# Accuracy is deterministic up to the order of float32 sums. Times are ratios to a reference
# workload of the same run, but still differ between machines: by 1.8 times in continuous
# integration.
METRICS = {
    "max_abs": Metric("max abs", "lower", 1.25),
    "relative": Metric("relative max", "lower", 1.25),
    "psnr": Metric("PSNR dB", "higher", 0.5, absolute=True),
    "gradient": Metric("gradient rel. L2", "lower", 1.25),
    "relative_99": Metric("relative, 99 %", "lower", 1.5),
    "gradient_99": Metric("gradient, best 99 %", "lower", 1.5),
    "forward": Metric("forward / reference", "lower", 2.5, timed=True),
    "both": Metric("forward + backward / reference", "lower", 2.5, timed=True),
    "step": Metric("training step / reference", "lower", 2.5, timed=True),
}
ACCURACY = ("max_abs", "relative", "psnr", "gradient")


class Complaint(NamedTuple):
    """A value that is worse than the baseline allows.

    Attributes:
        row: variant or scene.
        metric: name of the metric.
        timed: whether the metric is a time.
        text: a sentence that names the value, the baseline and the tolerance.
    """

    row: str
    metric: str
    timed: bool
    text: str


def write_baseline(path: Path, rows: Rows) -> None:
    """Write the baseline that `check` reads; other rows of an existing file stay."""
    known = json.loads(path.read_text()) if path.is_file() else {}
    write_json(path, known | rows)


def check(path: Path, rows: Rows) -> list[Complaint]:
    """Return a complaint for each value that is worse than the baseline allows.

    Raises:
        UserError: the baseline is missing, damaged, or lacks a variant or metric.
    """
    try:
        baseline = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} is not a valid baseline: {error}", fix="write one with --write-baseline"
        ) from error
    complaints = []
    for name, row in rows.items():
        for metric, value in row.items():
            known = baseline.get(name, {}).get(metric)
            if not isinstance(known, int | float):
                raise UserError(
                    f"{path} has no {metric!r} of {name!r}", fix="write a new one: --write-baseline"
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
    """Return one sentence for each value that is worse than the baseline allows.

    Other work on a machine makes times longer, never shorter. So rows whose times are worse are
    measured again, at most `again` times, and the least time counts. Accuracy is not measured
    again.

    Args:
        path: the baseline.
        rows: measured values, as for `check`.
        measure: returns new measurements of the rows of these names.
        again: largest number of repetitions.

    Raises:
        UserError: see `check`.
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
