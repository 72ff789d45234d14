"""Comparable wall times: medians of interleaved runs in one process, after a warm-up."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np


def interleaved(jobs: Mapping[str, Callable[[], Any]], repeats: int = 7) -> dict[str, float]:
    """Return the median wall time of each job, milliseconds.

    The jobs run in turns, so that a machine that slows down slows all, and each runs untimed
    first in every turn, so that it does not pay for the memory and caches of the one before (a
    small job after a large one read 2-3 times its time).
    """
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            jax.block_until_ready(job())
            start = time.perf_counter()
            jax.block_until_ready(job())
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(t)) * 1e3 for name, t in times.items()}
