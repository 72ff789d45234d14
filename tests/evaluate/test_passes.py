"""Results come in order, and arrays wait on disk where they would fill the memory."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from p2gs_jax.evaluation.passes import MOST_WORKERS, ArrayStore, map_in_order


def test_arrays_beyond_the_bound_lie_on_disk_until_the_end():
    arrays = [np.random.default_rng(k).normal(size=(50, 3)).astype(np.float32) for k in range(3)]
    with ArrayStore(most_bytes=arrays[0].nbytes) as store:
        kept = [store.put(a) for a in arrays]
        assert store.bytes_held == arrays[0].nbytes
        assert store.put(kept[1]) is kept[1]
        files = [k.path for k in kept if k.path is not None]
        assert len(files) == 2
        for a, k in zip(arrays, kept, strict=True):
            assert k.read().tobytes() == a.tobytes()
    assert not any(Path(f).exists() for f in files)


def test_results_keep_their_order_whatever_finishes_first():
    def slow_if_even(k):
        time.sleep(0.01 * (k % 2 == 0))
        return k * k

    assert list(map_in_order(slow_if_even, range(20))) == [k * k for k in range(20)]
    assert list(map_in_order(slow_if_even, [])) == []


def test_the_first_item_is_computed_alone_and_few_results_wait():
    running, done = [], []
    lock = threading.Lock()

    def counted(k):
        with lock:
            running.append(k)
        done.append(k)
        return k

    results = map_in_order(counted, range(100))
    assert running == []
    assert next(results) == 0
    assert running == [0]
    assert next(results) == 1
    time.sleep(0.05)
    assert len(running) <= 2 * MOST_WORKERS + 2
    results.close()
    assert len(done) < 100


def test_an_error_reaches_the_caller_and_ends_the_rest():
    seen = []

    def failing(k):
        seen.append(k)
        if k == 3:
            raise ValueError("no such view")
        return k

    with pytest.raises(ValueError, match="no such view"):
        list(map_in_order(failing, range(1000)))
    assert len(seen) < 1000
