"""Decodes photographs into files before they are asked for, in processes of their own.

Not multiprocessing: its children run the caller's script again, which then needs a guard, or fork
a process in which JAX has threads.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from p2gs_jax.scene.pixels.files import Key, PixelFiles
from p2gs_jax.types import View

MOST_PROCESSES = 4
# Starting a process takes as long as decoding some dozens.
FEWEST = 64
_STOPPING_S = 5.0


class DecodersAhead:
    """Processes that decode photographs in order, and who waits for them.

    What a process cannot decode is left to who asks for it, who then hears why.
    """

    def __init__(
        self,
        views: Sequence[View],
        files: PixelFiles,
        keys: Sequence[Sequence[Key]],
        processes: int | None = None,
    ):
        """Begin.

        Args:
            views: of the scene.
            files: that the photographs go to.
            keys: of every view the sizes that will be asked for.
            processes: how many; None: half as many as there are processors, at most four.
        """
        self._views, self._files, self._keys = views, files, keys
        self._changed = threading.Condition()
        self._busy: set[int] = set()
        self._closed = False
        missing = (row for row, sizes in enumerate(keys) if not all(map(files.has, sizes)))
        self._waiting = deque(missing)
        self._processes: list[subprocess.Popen[bytes]] = []
        if len(self._waiting) >= FEWEST:
            wanted = max(1, (os.cpu_count() or 1) // 2) if processes is None else processes
            for _ in range(min(wanted, MOST_PROCESSES)):
                self._start()

    def claim(self, row: int) -> None:
        """Take a view that is about to be decoded by the caller, or wait until it is decoded."""
        with self._changed:
            with contextlib.suppress(ValueError):
                self._waiting.remove(row)
            self._changed.wait_for(lambda: row not in self._busy)

    def close(self) -> None:
        """End the processes; what they had not begun is left."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.wait(_STOPPING_S)

    def _start(self) -> None:
        # Of a session of its own: an interrupt at the terminal is the caller's to handle.
        process = subprocess.Popen(
            [sys.executable, "-m", "p2gs_jax.scene.pixels.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
        )
        self._processes.append(process)
        thread = threading.Thread(target=self._feed, args=(process,), daemon=True, name="decode")
        thread.start()

    def _feed(self, process: subprocess.Popen[bytes]) -> None:
        """Give a process one view after another, until none is left or it has died."""
        assert process.stdin is not None
        assert process.stdout is not None
        alive = True
        while alive and (row := self._next()) is not None:
            try:
                pickle.dump(self._job(row), process.stdin)
                process.stdin.flush()
                alive = bool(process.stdout.read(1))
            except (OSError, ValueError):
                alive = False
            finally:
                with self._changed:
                    self._busy.discard(row)
                    self._changed.notify_all()
        with contextlib.suppress(OSError):
            process.stdin.close()

    def _next(self) -> int | None:
        with self._changed:
            if self._closed or not self._waiting:
                return None
            row = self._waiting.popleft()
            self._busy.add(row)
            return row

    def _job(self, row: int) -> tuple[View, list[tuple[int, int]], list[Path]]:
        keys = [key for key in self._keys[row] if not self._files.has(key)]
        sizes = [(key.width, key.height) for key in keys]
        return self._views[row], sizes, [self._files.path(key) for key in keys]
