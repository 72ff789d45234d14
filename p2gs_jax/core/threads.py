"""The number of cores for this process, and a threaded map that holds few results at once."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from p2gs_jax.core.memory import CGROUP, text_of

Item = TypeVar("Item")
Result = TypeVar("Result")

# Largest number of threads, which bounds the images in memory.
MOST_WORKERS = 4


def available_cores() -> int:
    """Return the number of cores for this process, by its affinity and its container's limit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    # The file holds "QUOTA PERIOD" in microseconds, or "max PERIOD" without a limit.
    quota, _, period = text_of(CGROUP / "cpu.max").partition(" ")
    if quota.isdecimal() and period.isdecimal():
        cores = min(cores or 1, int(quota) // max(int(period), 1))
    return max(cores or 1, 1)


def map_in_order(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield a function's results in the order of the items, computed in threads.

    NumPy, JAX and image readers release the interpreter's lock. The first item is computed alone,
    so that programs compile once. `Executor.map` would submit all items at once; here memory holds
    at most one result more than there are threads.
    """
    workers = min(available_cores(), MOST_WORKERS)
    rest = iter(items)
    for first in rest:
        yield function(first)
        break
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="views") as pool:
        try:
            for item in rest:
                waiting.append(pool.submit(function, item))
                if len(waiting) > workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
