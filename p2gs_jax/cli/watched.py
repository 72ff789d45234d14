"""A fit beside which the viewer runs."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

from p2gs_jax.core.processes import environment
from p2gs_jax.core.progress import LogRecord, TerminalReporter


class WatchedReporter(TerminalReporter):
    """Starts `p2gs-jax view` for a run at its first steps; the viewer ends with the fit."""

    def __init__(self, run: Path, port: int):
        super().__init__()
        view = [sys.executable, "-m", "p2gs_jax.cli", "view", str(run), "--port", str(port)]
        self._command: list[str] | None = [*view, "--with-fit"]

    def log(self, record: LogRecord) -> None:
        """Start the viewer once, and show the progress."""
        if self._command is not None:
            threading.Thread(target=self._view, args=(self._command,), daemon=True).start()
            self._command = None
        super().log(record)

    def _view(self, command: list[str]) -> None:
        """Run the viewer, and repeat its output; Ctrl-C does not reach it."""
        output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        group = {"process_group": 0, "env": environment()}
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, **output, **group) as viewer:
            for line in viewer.stdout or ():
                self.message(line.rstrip())
