"""Memory of one large view, in a process of its own."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

# Gaussians, width, height, median radius in pixels.
SIZES = (
    (20_000, 640, 360, 4.0),
    (100_000, 960, 650, 3.0),
    (300_000, 960, 650, 2.0),
    (1_000_000, 1920, 1300, 3.0),
)


class Footprint(NamedTuple):
    """Resident memory of a process that renders one view, megabytes.

    Attributes:
        gaussians: count.
        width: pixels.
        height: pixels.
        entries: tile-list entries.
        runtime: Python and JAX before the scene exists.
        compiling: peak while the programs were compiled.
        forward: peak of a forward render once they are.
        both: peak of forward and backward once they are.
        temporaries: what forward and backward allocate beside inputs and outputs.
        forward_ms: a warm forward render.
        both_ms: a warm forward and backward.
    """

    gaussians: int
    width: int
    height: int
    entries: int
    runtime: float
    compiling: float
    forward: float
    both: float
    temporaries: float
    forward_ms: float
    both_ms: float


def footprint(gaussians: int, width: int, height: int, radius: float) -> Footprint:
    """Render a street in a fresh process and return its peak memory.

    Raises:
        RuntimeError: the process failed, as it does when memory runs out.
    """
    arguments = json.dumps([gaussians, width, height, radius])
    done = subprocess.run(
        [sys.executable, "-m", "p2gs_jax.bench.memory", arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(
            f"rendering {gaussians} Gaussians at {width}x{height} failed "
            f"(exit {done.returncode}): {done.stderr.strip()[-400:]}"
        )
    return Footprint(*json.loads(done.stdout.strip().splitlines()[-1]))


def _peak() -> float:
    try:
        status = Path("/proc/self/status").read_text()
        return int(re.findall(r"VmHWM:\s+(\d+)", status)[0]) / 1024
    except (OSError, IndexError):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)


def _forget_peak() -> None:
    """Give freed memory back and restart the peak, where the system can (Linux)."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")


def _measure(gaussians: int, width: int, height: int, radius: float) -> Footprint:
    import jax

    from p2gs_jax.bench.scenes import street
    from p2gs_jax.bench.speed_error import DEFAULT, cotangent, programs
    from p2gs_jax.bench.timing import interleaved
    from p2gs_jax.config import RenderConfig

    jax.block_until_ready(jax.numpy.zeros(1))
    runtime = _peak()
    scene = street(gaussians, width, height, radius=radius)
    forward, both, _, entries, temporaries = programs(
        scene, DEFAULT, RenderConfig(), cotangent(scene)
    )
    compiling = _peak()
    _forget_peak()
    forward_ms = interleaved({"f": forward}, 3)["f"]
    peak_forward = _peak()
    _forget_peak()
    both_ms = interleaved({"b": both}, 3)["b"]
    return Footprint(
        gaussians,
        width,
        height,
        entries,
        runtime,
        compiling,
        peak_forward,
        _peak(),
        temporaries / 1e6,
        forward_ms,
        both_ms,
    )


if __name__ == "__main__":
    print(json.dumps(_measure(*json.loads(sys.argv[1]))))
