"""A run that a fit still writes: its snapshots, its log, and its results at the end."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from p2gs_jax.errors import UserError
from p2gs_jax.run.folder import RunFolder, require_free
from p2gs_jax.run.read import Run, load_run

# Seconds between two looks at the run folder.
POLL_S = 1.0


class Follower:
    """Requests snapshots of a fit, and reads them.

    `files` has the paths of the run. If `with_fit`, the viewer ends with the fit.
    """

    def __init__(self, folder: Path, scene: Path | None = None, *, with_fit: bool = False):
        """Follow the run in a folder; `scene` is as for `load_run`."""
        self.files, self._scene, self.with_fit = RunFolder(folder), scene, with_fit
        self._seen = 0  # time of the snapshot that was read last, nanoseconds
        self._went_on = False  # whether the fit went on at the last poll

    @property
    def goes_on(self) -> bool:
        """Whether a fit is writing the run: the folder is locked and has no scores yet."""
        try:
            require_free(self.files.root)
        except UserError:
            return not self.files.metrics.exists()
        return False

    def first(self, say: Callable[[str], None]) -> Run:
        """Return the run as soon as it can be shown; UserError: see `load_run`.

        `say` receives a message about a wait.
        """
        if self.goes_on:
            say("Waiting for the first steps of the fit ...")
        while self.goes_on:
            if (run := self.poll(wanted=True)) is not None:
                return run
            time.sleep(POLL_S)
        return self._latest()

    def poll(self, *, wanted: bool) -> Run | None:
        """Return a newer state of the run, or None; if `wanted`, request a snapshot."""
        before, self._went_on = self._went_on, self.goes_on
        try:
            if not self._went_on:
                return self._latest() if before else None
            if wanted:
                self.files.wanted.touch()
            now = self.files.snapshot.stat().st_mtime_ns
            run = None if now == self._seen else self._latest()
        except (OSError, UserError):  # there is no snapshot, or another one replaces it
            return None
        self._seen = now
        return run

    def _latest(self) -> Run:
        """Return the snapshot of an unfinished run, or the finished run."""
        unfinished = self.files.snapshot.is_dir()
        return load_run(self.files.root, self._scene, snapshot=unfinished)
