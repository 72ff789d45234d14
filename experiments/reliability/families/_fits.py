"""Fits in separate processes, ended in every way, and the files that they leave behind."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

OPTIONS = (
    *("--steps", "120", "--train.checkpoint-every-s", "0", "--train.coarse-to-fine"),
    *("--densify.max-gaussians", "300", "--densify.min-every-steps", "10"),
    *("--render.sh-degree", "0", "--init.shell", "off", "--init.dense", "off"),
)
# No trial may hang.
MOST_S = 300.0
# No compiler effort: speed is not tested, and compiling would take most of the time.
_FLAGS = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"


class Trial(Exception):
    """The result of a trial that should have been another."""


def command(scene: Path, run: Path, *extra: str) -> list[str]:
    """Return the command of a fit."""
    return [
        *(sys.executable, "-m", "p2gs_jax.cli", "fit", str(scene), "--out", str(run)),
        *OPTIONS,
        *extra,
    ]


def environment(cache: Path) -> dict[str, str]:
    """Return variables with which fits share compiled programs, by default in `cache`."""
    return os.environ | {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": _FLAGS,
        "JAX_COMPILATION_CACHE_DIR": os.environ.get("JAX_COMPILATION_CACHE_DIR", str(cache)),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "COLUMNS": "500",
    }


class Ended:
    """A fit that has ended.

    Attributes:
        code: exit code; negative: the signal that killed it.
        said: on standard error.
    """

    def __init__(self, code: int, said: str):
        self.code, self.said = code, said

    def require(self, code: int, *words: str) -> None:
        """Check how it ended.

        Raises:
            Trial: by another code, with a traceback, or without the words.
        """
        tail = " ".join(self.said.split())[-300:]
        if "Traceback" in self.said:
            raise Trial(f"a traceback: {tail}")
        if self.code != code:
            raise Trial(f"exit code {self.code} instead of {code}: {tail}")
        missing = [word for word in words if word not in " ".join(self.said.split())]
        if missing:
            raise Trial(f"it does not say {missing[0]!r}: {tail}")


@contextlib.contextmanager
def started(argv: Sequence[str], env: dict[str, str], **options: Any) -> Iterator[subprocess.Popen]:
    """Start a process; it is killed where the block ends before it."""
    process = subprocess.Popen(
        argv, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **options
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def end(process: subprocess.Popen) -> Ended:
    """Wait for a process.

    Raises:
        Trial: it hangs.
    """
    try:
        _, said = process.communicate(timeout=MOST_S)
    except subprocess.TimeoutExpired as error:
        raise Trial(f"it hung for {MOST_S:.0f} s") from error
    return Ended(process.returncode, said)


def run(argv: Sequence[str], env: dict[str, str], **options: Any) -> Ended:
    """Run a process to its end."""
    with started(argv, env, **options) as process:
        return end(process)


def wait_for(process: subprocess.Popen, there: Callable[[], bool]) -> bool:
    """Wait until something is there; return False where the process ended first."""
    begin = time.monotonic()
    while process.poll() is None:
        if there():
            return True
        if time.monotonic() - begin > MOST_S:
            raise Trial("it never came so far")
        time.sleep(0.002)
    return False


def lines(run: Path) -> int:
    """Return how many lines the log of a run has."""
    with contextlib.suppress(OSError):
        return (run / "log.jsonl").read_bytes().count(b"\n")
    return 0


def content(run: Path) -> tuple:
    """Return the repeatable results of a run: log without times, Gaussians, photometry, scores."""
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    times = ("seconds", "step_seconds", "left_s")
    timeless = [{k: v for k, v in r.items() if k not in times} for r in log]
    metrics = json.loads((run / "metrics.json").read_text())
    return (
        timeless,
        (run / "radiance.ply").read_bytes(),
        (run / "photometry.json").read_bytes(),
        metrics["train"],
        metrics["test"],
    )


def require_same(a: Path, b: Path) -> None:
    """Compare two runs.

    Raises:
        Trial: they differ.
    """
    names = ("log.jsonl", "radiance.ply", "photometry.json", "train scores", "test scores")
    for name, x, y in zip(names, content(a), content(b), strict=True):
        if x != y:
            raise Trial(f"resumed, {name} differs from the uninterrupted run's")
    left = [p.name for p in b.rglob("*") if p.name.startswith((".writing", ".trying", ".lock"))]
    if left:
        raise Trial(f"left behind: {', '.join(left)}")
