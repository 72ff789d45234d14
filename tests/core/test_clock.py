"""Named seconds, and counted compilations."""

import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.core.clock import CompileCounter, Stopwatch


def test_seconds_of_a_name_add_up_in_the_order_of_first_use():
    watch = Stopwatch()
    with watch("reading"):
        time.sleep(0.01)
    with pytest.raises(ValueError, match="no"), watch("steps"):
        raise ValueError("no")
    with watch("reading"):
        time.sleep(0.01)
    watch.add("steps", 2.0)
    assert list(watch.seconds) == ["reading", "steps"]
    assert watch.seconds["reading"] >= 0.02
    assert 2.0 <= watch.seconds["steps"] < 2.01


def test_programs_are_counted_once_each():
    counter = CompileCounter()
    shift = np.random.default_rng().integers(1 << 30).item()
    program = jax.jit(lambda x: x + shift)
    program(np.float32(1))
    program(np.float32(2))
    assert counter.programs == 1
    assert counter.seconds > 0
    program(np.zeros(3, np.float32))
    assert counter.programs == 2
    later = CompileCounter()
    program(np.zeros(3, np.float32))
    assert later.programs == 0
    assert later.seconds == 0


def test_what_other_threads_compile_is_counted():
    counter = CompileCounter()
    programs = [jax.jit(lambda x, k=k: jnp.sum(x * k)) for k in range(4)]
    threads = [threading.Thread(target=p, args=(np.zeros(5 + k),)) for k, p in enumerate(programs)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counter.programs == 4
