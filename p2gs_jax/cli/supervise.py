"""One process of several is watched by its parent: whatever ends it, the user is told where.

JAX ends a process whose partner died on the spot, from a thread of C++: no exception reaches
Python. So the fit runs in a child, and the parent says what happened and exits with code 2.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from p2gs_jax.cli import PARENT
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.core.interrupts import SIGNALS
from p2gs_jax.errors import UserError
from p2gs_jax.run.checkpoint import saved_steps
from p2gs_jax.run.folder import RunFolder

# Exit code of a child that lost its partners.
LOST = 70


def is_child() -> bool:
    """Return whether a parent watches this process."""
    return PARENT in os.environ


def end_with_parent() -> None:
    """End this process when its parent ends, however that ends."""
    pipe = int(os.environ[PARENT])

    def wait() -> None:
        os.read(pipe, 1)
        os._exit(LOST)

    threading.Thread(target=wait, daemon=True).start()


def supervise(argv: Sequence[str], run_dir: Path) -> int:
    """Run a command in a child and return its exit code.

    Args:
        argv: of the command.
        run_dir: of the fit.

    Raises:
        UserError: the child ended as no command does.
    """
    theirs, ours = os.pipe()
    command = [sys.executable, "-m", "p2gs_jax.cli", *argv]
    env = os.environ | {PARENT: str(theirs)}
    child = subprocess.Popen(command, env=env, pass_fds=(theirs,))
    os.close(theirs)
    before = {number: signal.signal(number, _passed_to(child)) for number in SIGNALS}
    try:
        code = child.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(ours)
    if 0 <= code != LOST and code != 1:
        return code
    raise UserError(
        f"A process of this fit ended ({_ending(code)}), and with it all of them: "
        f"{where(run_dir)}.",
        fix="look above, and at the other processes, for the reason; then start all of them again "
        "with --resume",
    )


def _passed_to(child: subprocess.Popen):
    def pass_on(number, frame) -> None:
        del frame
        # Ctrl-C reaches the whole group, the child too.
        if number != signal.SIGINT:
            child.send_signal(number)

    return pass_on


def _ending(code: int) -> str:
    if code == LOST:
        return "it lost another one"
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def where(run_dir: Path) -> str:
    """Return in words how far a run came, from its folder."""
    folder = RunFolder(run_dir)
    steps = []
    if folder.log.exists():
        steps = [line["step"] for line in read_jsonl(folder.log)]
    saved = saved_steps(folder.checkpoints)
    at = f"step {steps[-1]} was the last in the log" if steps else "no step was logged yet"
    if not saved:
        return f"{at}, and no checkpoint was written yet"
    return f"{at}, the last checkpoint is step {max(saved)} in {folder.checkpoints}"
