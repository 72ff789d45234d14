"""A job in a separate process on any machine: `python -m p2gs_jax.jobs.worker JOB.json`.

The end of a process frees its memory, and killing it harms no other job. When the
caller ends, standard input closes and the process exits: no two processes write to one folder.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import traceback
from pathlib import Path

from p2gs_jax.core import interrupts
from p2gs_jax.core.memory import ran_out
from p2gs_jax.core.processes import environment
from p2gs_jax.errors import UserError
from p2gs_jax.jobs import job as records

# Seconds between two checks for the file that asks jobs to stop.
LOOK_S = 0.2
LESS = "let fewer jobs run at a time, or lower --gaussians or --max-width"
# Exit codes of a job that stopped after a signal and wrote its checkpoint.
SIGNALLED = tuple(interrupts.exit_code(interrupts.Interrupted(n)) for n in interrupts.SIGNALS)


def run_in_process(job_path: str) -> tuple[records.Status, str | None]:
    """Run the job of a file in a process and wait for it; engines call this function.

    Returns its status, and the reason if it is `failed` or `lost`. A job is lost if a signal other
    than SIGKILL ended it and this caller did not send that signal.
    """
    files = records.JobFiles(Path(job_path))
    folder = records.read_job(files.path).folder
    if files.stop.exists():
        return "stopped", None
    (folder / records.REASON).unlink(missing_ok=True)  # of an earlier start
    files.progress.unlink(missing_ok=True)
    with files.output.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "p2gs_jax.jobs.worker", job_path],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment(),
            # Ctrl-C reaches only the caller of the jobs, which asks each job once to stop.
            process_group=0,
        )
        stopped = _wait(process, files.stop)
    if process.returncode == 0:
        return "done", None
    if (folder / records.REASON).exists():
        return "failed", records.read_reason(folder)
    if stopped:
        return "stopped", None
    reason, code = _why(process.returncode, files.output), process.returncode
    # This caller did not stop it: a batch system needs the node, or the time limit was reached.
    # SIGKILL is excluded, because a job that ran out of memory would do so again.
    if code in SIGNALLED or (code < 0 and code != -signal.SIGKILL):
        return "lost", reason
    records.write_reason(folder, reason)
    return "failed", reason


def _wait(process: subprocess.Popen, stop: Path) -> bool:
    """Wait until a process ends; return whether it was asked to stop."""
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
        return f"its process was killed (SIGKILL), probably because memory ran out: {LESS}"
    by = f"by {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
    lines = output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f"its process ended {by}: {(lines or ['no message'])[-1]}"


def main(job_path: Path) -> int:
    """Run the job of a file in this process; return the exit code, 0 after success.

    A failure of the task leaves its reason in the folder of the job; a signal does not.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job = records.read_job(job_path)
    progress = records.ProgressFile(records.JobFiles(job_path).progress)
    progress.stage("Starting")
    try:
        with interrupts.raised():
            job.task(job.folder, job.arguments, progress)
    except KeyboardInterrupt as error:
        return interrupts.exit_code(error)
    except UserError as error:
        records.write_reason(job.folder, str(error))
        return 2
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        reason += f"; memory ran out: {LESS}" if ran_out(error) else ""
        text = "".join(traceback.format_exception(error))
        records.write_reason(job.folder, reason, traceback=text)
        return 1
    return 0


def _end_with_parent() -> None:
    """Wait for the end of the caller and exit at once: the job may start again in its folder."""
    with contextlib.suppress(OSError):
        while os.read(0, 1):
            pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
