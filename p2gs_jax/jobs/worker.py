"""One job, in this process: `python -m p2gs_jax.jobs.worker JOB.json`."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import traceback
from pathlib import Path

from p2gs_jax.core import interrupts
from p2gs_jax.core.atomic import write_json
from p2gs_jax.errors import UserError
from p2gs_jax.jobs.job import REASON, JobFiles, read_job
from p2gs_jax.jobs.progress import ProgressFile


def main(job_path: Path) -> int:
    """Do what a job file says; 0 where it succeeded.

    A failure leaves its reason in the job's folder; a signal that asks for the end does not.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job = read_job(job_path)
    progress = ProgressFile(JobFiles(job_path).progress)
    progress.stage("Starting")
    try:
        with interrupts.raised():
            job.task(job.folder, job.arguments, progress)
    except KeyboardInterrupt as error:
        return interrupts.exit_code(error)
    except UserError as error:
        _leave(job.folder, {"reason": str(error)})
        return 2
    except Exception as error:
        text = "".join(traceback.format_exception(error))
        _leave(job.folder, {"reason": f"{type(error).__name__}: {error}", "traceback": text})
        return 1
    return 0


def _leave(folder: Path, reason: dict[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / REASON, reason)


def _end_with_parent() -> None:
    """End at once when whoever waits is gone: the job is begun again elsewhere, in this folder."""
    with contextlib.suppress(OSError):
        while os.read(0, 1):
            pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
