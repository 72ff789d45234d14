"""Results come in order, few wait, and an error reaches the caller."""

import threading
import time

import pytest

from p2gs_jax.evaluation.passes import MOST_WORKERS, map_in_order


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
