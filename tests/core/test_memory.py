"""The memory of a machine, container and process; the errors that mean that it ran out."""

import errno
import resource

import pytest

from p2gs_jax.core import memory


@pytest.fixture
def container(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "CGROUP", tmp_path)
    monkeypatch.setattr(memory, "MEMINFO", tmp_path / "meminfo")
    lines = "MemTotal:  8000000 kB\nMemAvailable:  6000000 kB\nHugePages_Total:  0\n"
    (tmp_path / "meminfo").write_text(lines)
    return tmp_path


def test_memory_is_that_of_the_system_or_its_container(container):
    system = (8_000_000 * 1024, 6_000_000 * 1024)
    assert memory.memory() == system
    (container / "memory.max").write_text("1000000000\n")
    (container / "memory.current").write_text("400000000\n")
    assert memory.memory() == (1_000_000_000, 600_000_000)
    # Memory of cached files counts as available.
    (container / "memory.current").write_text("900000000\n")
    (container / "memory.stat").write_text("anon 300000000\ninactive_file 500000000\n")
    assert memory.memory() == (1_000_000_000, 600_000_000)
    (container / "memory.max").write_text("max\n")
    assert memory.memory() == system


def test_a_process_is_bounded_by_the_machine_and_its_limit(container, monkeypatch):
    monkeypatch.setattr(memory, "STATM", container / "statm")
    (container / "meminfo").write_text((container / "meminfo").read_text() + "SwapFree: 1000 kB\n")
    free = 6_001_000 * 1024
    assert memory.left_to_process() == free
    (container / "statm").write_text("500 200 5 1 0 9 0")
    page = resource.getpagesize()
    assert memory.resident() == 200 * page
    for limit, left in (
        (700 * page, 200 * page),
        (400 * page, 0),
        (free + 600 * page, free),
        (resource.RLIM_INFINITY, free),
    ):
        monkeypatch.setattr(memory.resource, "getrlimit", lambda what, limit=limit: (limit, limit))
        assert memory.left_to_process() == left


class JaxRuntimeError(RuntimeError):
    """An exception with the name of JAX's."""


@pytest.mark.parametrize(
    ("error", "ran_out"),
    [
        (MemoryError(), True),
        (JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes."), True),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), True),
        (RuntimeError("can't start new thread"), True),
        (OSError(errno.ENOSPC, "No space left on device"), False),
        (JaxRuntimeError("INTERNAL: no"), False),
        (ValueError("RESOURCE_EXHAUSTED"), False),
    ],
)
def test_errors_that_mean_memory_ran_out_are_recognised(error, ran_out):
    assert memory.ran_out(error) == ran_out
