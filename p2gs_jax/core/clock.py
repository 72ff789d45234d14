"""Durations by name, and a note on an exceeded budget."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any


class Stopwatch:
    """Durations by name, wall seconds, in the order in which the names were first used.

    Durations of the same name are added. Threads may share a stopwatch; overlapping parts are both
    counted in full.
    """

    def __init__(self, seconds: Mapping[str, float] | None = None):
        self.seconds = dict(seconds or {})
        self._lock = threading.Lock()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the seconds of a `with` block to a name, also if the block raises an error."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.add(name, time.perf_counter() - begin)

    def add(self, name: str, seconds: float) -> None:
        """Add seconds that were measured elsewhere to a name."""
        with self._lock:
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds


# Entries of `seconds` in metrics.json that are sums of other entries.
SUMS = ("total_until_evaluation", "optimisation", "evaluation_and_files")
# A run may take its budget times this factor, plus these seconds, without a note.
LATE = (1.1, 2.0)
MOST_NAMED = 4  # parts of a run in a note


def whole_run(seconds: Mapping[str, Any]) -> float | None:
    """Return the duration of a run, s, from `seconds` of its metrics.json; None: unknown."""
    parts = [seconds.get(k) for k in ("total_until_evaluation", "evaluation_and_files")]
    known = [p for p in parts if isinstance(p, int | float) and not isinstance(p, bool)]
    return float(sum(known)) if known else None


def over_budget(budget_s: float | None, seconds: Mapping[str, float]) -> str | None:
    """Return a note with the longest parts of a run that exceeded its budget clearly, or None.

    `seconds` is the entry of this name in metrics.json.
    """
    total = whole_run(seconds)
    if budget_s is None or total is None or total <= LATE[0] * budget_s + LATE[1]:
        return None
    parts = sorted(((v, k) for k, v in seconds.items() if k not in SUMS), reverse=True)
    named = ", ".join(f"{k.replace('_', ' ')} {v:.0f}" for v, k in parts[:MOST_NAMED] if v >= 0.5)
    return (
        f"The budget of {budget_s:.0f} s was exceeded: the run took {total:.0f} s ({named}). A "
        "budget shortens the optimisation only, not the work before and after it."
    )
