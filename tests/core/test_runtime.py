"""Memory that a process keeps or returns, compiled programs on disk, and its number of cores."""

import os
import sys

import pytest

from p2gs_jax.core import runtime, threads

SCRIPT = """
import resource
import numpy as np
from p2gs_jax.core.runtime import keep_freed_memory, return_freed_memory

def resident_mb():
    pages = int(open("/proc/self/statm").read().split()[1])
    return pages * resource.getpagesize() / 2**20

assert keep_freed_memory()
begin = resident_mb()
arrays = [np.ones(2**20) for _ in range(40)]
arrays[-1][:] = 2.0
last = arrays.pop()
del arrays
kept = resident_mb() - begin
return_freed_memory()
print(kept, resident_mb() - begin, last.sum())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc only")
def test_freed_memory_is_kept_until_it_is_handed_back(python):
    kept, left, total = map(float, python("-c", SCRIPT).stdout.split())
    assert total == 2**21
    assert kept > 300
    assert left < 40


@pytest.mark.parametrize(("largest", "succeeds"), [(2**30, True), (2**25, True), (0, False)])
def test_a_library_that_refuses_one_setting_gets_the_others(monkeypatch, largest, succeeds):
    """Older versions of glibc refuse thresholds above 32 MB."""
    settings = []

    def mallopt(what, value):
        settings.append(what)
        return int(what != -3 or value <= largest)

    monkeypatch.setattr(runtime, "_of_glibc", lambda name: mallopt)
    assert runtime.keep_freed_memory() == succeeds
    assert set(settings) == {-1, -2, -3}


CHILD = """
import os, jax, jax.numpy as jnp
from p2gs_jax.core import runtime
runtime.SHORTEST_S = 0.0
runtime.use_compile_cache()
runtime.use_cores(3 if os.environ.get("CORES") else None)
print(jax.config.values["jax_compilation_cache_dir"])
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((8, 8))).block_until_ready()
from p2gs_jax.train.divided import mesh_of_cores
mesh = mesh_of_cores()
assert jax.device_count() == (mesh.size if mesh else 1)
runtime.use_cores()  # leaves it alone
print(jax.device_count())
"""


def run(python, **variables) -> str:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    done = python("-c", CHILD, env=kept, JAX_PLATFORMS="cpu", **variables)
    folder, cores = done.stdout.splitlines()
    stated = variables.get("CORES") or variables.get("JAX_NUM_CPU_DEVICES")
    default = runtime.DEFAULT_CORES
    assert int(cores) == int(stated or (default if threads.available_cores() >= default else 1))
    return folder


def test_compiled_programs_are_cached_in_a_writable_folder(python, tmp_path):
    assert run(python, XDG_CACHE_HOME=str(tmp_path)).startswith(str(tmp_path / "p2gs-jax"))
    assert list((tmp_path / "p2gs-jax").rglob("*-cache"))
    chosen = str(tmp_path / "chosen")
    set_otherwise = {"JAX_COMPILATION_CACHE_DIR": chosen, "JAX_NUM_CPU_DEVICES": "2", "CORES": "3"}
    assert run(python, XDG_CACHE_HOME=str(tmp_path / "xdg"), **set_otherwise) == chosen
    assert not (tmp_path / "xdg").exists()
    (tmp_path / "file").write_text("in the way")
    # A number of cores in the environment stays as well.
    assert run(python, XDG_CACHE_HOME=str(tmp_path / "file"), JAX_NUM_CPU_DEVICES="1") == "None"


@pytest.mark.parametrize(
    ("limit", "cores"), [("max 100000", 4), ("250000 100000", 2), ("50000 100000", 1), ("", 4)]
)
def test_a_process_has_the_cores_of_its_affinity_and_its_container(
    monkeypatch, tmp_path, limit, cores
):
    (tmp_path / "cpu.max").write_text(limit)
    monkeypatch.setattr(threads, "CGROUP", tmp_path)
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda process: {0, 1, 2, 5})
    assert threads.available_cores() == cores
