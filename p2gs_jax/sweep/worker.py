"""One fit of a sweep, in a process of its own: `python -m p2gs_jax.sweep.worker JOB.json`."""

from __future__ import annotations

import json
import sys
import time
import traceback
from pathlib import Path

from p2gs_jax.config import from_dict
from p2gs_jax.core import interrupts
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.compile_cache import use_compile_cache
from p2gs_jax.core.runtime import tune_process
from p2gs_jax.errors import UserError
from p2gs_jax.pipeline.fit import fit
from p2gs_jax.run.layout import RunFolder

REASON = "failure.json"


def main(job_path: Path) -> int:
    """Run the fit that a job file describes; 0 where it succeeded.

    A failure leaves its reason in the run folder; a signal that asks for the end does not.
    """
    job = json.loads(job_path.read_text(encoding="utf-8"))
    run = Path(job["run"])
    use_compile_cache()
    tune_process()
    try:
        with interrupts.raised():
            fit(
                job["scene"],
                run,
                from_dict(job["fit"]),
                reference=job["reference"],
                resume=RunFolder(run).config.exists(),
                # As for `p2gs-jax fit`: starting the interpreter counts.
                spent_s=time.process_time(),
            )
    except KeyboardInterrupt as error:
        return interrupts.exit_code(error)
    except UserError as error:
        write_json(run / REASON, {"reason": str(error)})
        return 2
    except Exception as error:
        text = "".join(traceback.format_exception(error))
        write_json(run / REASON, {"reason": f"{type(error).__name__}: {error}", "traceback": text})
        return 1
    (run / REASON).unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
