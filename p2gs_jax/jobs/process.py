"""A job in a process of its own: what engines call, on whichever machine.

A process gives its memory back, and one that the system kills takes nothing else with it. It ends
with whoever waits for it: its standard input closes then, and nobody writes to the folder twice.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.interrupts import SIGNALS, Interrupted, exit_code
from p2gs_jax.jobs.job import REASON, JobFiles, Status, read_job, read_reason

# Seconds between looks at the file that asks for the end.
LOOK_S = 0.2
# How a job ends that was asked to, and left its checkpoint.
ASKED = tuple(exit_code(Interrupted(number)) for number in SIGNALS)


def run_in_process(job_path: str) -> tuple[Status, str | None]:
    """Run a job and wait for it.

    Args:
        job_path: of the job file.

    Returns:
        How it ended, and why it failed; `lost` where a signal ended its process.
    """
    files = JobFiles(Path(job_path))
    folder = read_job(files.path).folder
    if files.stop.exists():
        return "stopped", None
    (folder / REASON).unlink(missing_ok=True)  # of an earlier try
    files.progress.unlink(missing_ok=True)
    with files.output.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "p2gs_jax.jobs.worker", job_path],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            # Ctrl-C reaches whoever asked for the jobs, who asks each of them once.
            process_group=0,
        )
        stopped = _wait(process, files.stop)
    if process.returncode == 0:
        return "done", None
    if (folder / REASON).exists():
        return "failed", read_reason(folder)
    if stopped:
        return "stopped", None
    reason = _why(process.returncode, files.output)
    # Nobody here asked it to end: a batch system takes the node back, or its time is over.
    if process.returncode < 0 or process.returncode in ASKED:
        return "lost", reason
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / REASON, {"reason": reason})
    return "failed", reason


def _wait(process: subprocess.Popen, stop: Path) -> bool:
    """Wait until a process ends; return whether it was asked to."""
    asked = False
    try:
        while True:
            try:
                process.wait(LOOK_S)
                return asked
            except subprocess.TimeoutExpired:
                if not asked and stop.exists():
                    asked = True
                    process.terminate()
    finally:
        if process.stdin is not None:
            process.stdin.close()


def _why(code: int, output: Path) -> str:
    if code == -signal.SIGKILL:
        return (
            "its process was killed (SIGKILL), often because memory ran out: let fewer run at a "
            "time, or lower --gaussians or --max-width"
        )
    by = f"by {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
    lines = output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f"its process ended {by}: {(lines or ['no message'])[-1]}"
