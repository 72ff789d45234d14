"""Memory that a process keeps between steps, and hands back between the parts of a run."""

import subprocess
import sys

import pytest

SCRIPT = """
import numpy as np
from p2gs_jax.core.runtime import keep_freed_memory, return_freed_memory

import resource

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
def test_freed_memory_is_kept_until_it_is_handed_back():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True, timeout=60
    )
    kept, left, total = map(float, done.stdout.split())
    assert total == 2**21
    assert kept > 300
    assert left < 40
