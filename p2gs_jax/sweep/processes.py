"""The processes of a sweep: each is waited for, all are asked to end together."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Sequence


class Processes:
    """Runs commands from several threads until it is stopped.

    Attributes:
        stopped: `stop` was called.
    """

    def __init__(self):
        self.stopped = False
        self._running: set[subprocess.Popen] = set()
        self._lock = threading.Lock()

    def run(self, command: Sequence[str]) -> str | None:
        """Run a command and wait for it.

        Returns:
            Why it failed; None where it did not, or was stopped by `stop`.
        """
        with self._lock:
            if self.stopped:
                return None
            # In a group of their own: Ctrl-C reaches the sweep, which asks each of them once.
            process = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                process_group=0,
            )
            self._running.add(process)
        try:
            _, said = process.communicate()
        finally:
            with self._lock:
                self._running.discard(process)
        return None if process.returncode == 0 or self.stopped else _why(process.returncode, said)

    def stop(self) -> None:
        """Ask all that run to end (SIGTERM), and begin no more."""
        with self._lock:
            self.stopped = True
            for process in self._running:
                process.terminate()


def _why(code: int, said: str) -> str:
    if code == -signal.SIGKILL:
        return (
            "the process was killed (SIGKILL); often because memory ran out: let fewer run at a "
            "time, or lower --gaussians or --max-width"
        )
    by = f"by {signal.Signals(-code).name}" if code < 0 else f"with code {code}"
    tail = (said.strip().splitlines() or ["no message"])[-1]
    return f"the process ended {by}: {tail}"
