"""Long computations: results are kept in the run folder for a resume, progress is reported."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from p2gs_jax.core.atomic import write_text

Report = Callable[[str], None]
"""Receives progress, a line at a time."""
_MARKER = "finished"
# Seconds between two messages.
EVERY_S = 10.0


@contextmanager
def cached_folder(
    work_dir: Path | None, name: str, key: object, build: Callable[[Path], None]
) -> Iterator[Path]:
    """Provide a folder that `build` has filled, now or in an earlier run.

    It counts as finished once a marker with the hash of `key`, JSON of everything the result
    depends on, has been moved into it; one that was interrupted half-way, or made from other
    inputs, is emptied and filled again. A `work_dir` of None makes it a temporary folder.
    """
    if work_dir is None:
        with tempfile.TemporaryDirectory(prefix="p2gs_") as temporary:
            build(Path(temporary))
            yield Path(temporary)
        return
    folder = work_dir / name
    marker = folder / _MARKER
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()
    if not (marker.is_file() and marker.read_text().strip() == digest):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        build(folder)
        write_text(marker, digest)
    yield folder


def file_fingerprints(paths: Sequence[Path]) -> list[tuple[str, int, int]]:
    """Return (path, size in bytes, modification time in ns) of every file."""
    stats = [(path, path.stat()) for path in paths]
    return [(str(path.resolve()), stat.st_size, stat.st_mtime_ns) for path, stat in stats]


class StageProgress:
    """Reports now and then how far a stage is; the first message comes at once."""

    def __init__(
        self,
        report: Report,
        stage: str,
        total: int,
        unit: str,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Begin the stage, such as "matching", of so many units, such as "image pairs"."""
        self._report, self._stage, self._total, self._unit = report, stage, total, unit
        self._clock = clock
        self._begin = self._last = clock()
        if total:
            report(f"{stage}: {total} {unit}")

    def __call__(self, done: int) -> None:
        """Report how many are done, unless a message came just before."""
        now = self._clock()
        if now - self._last < EVERY_S or not 0 < done < self._total:
            return
        self._last = now
        left = round((now - self._begin) / done * max(self._total - done, 0))
        minutes, seconds = divmod(left, 60)
        hours, minutes = divmod(minutes, 60)
        clock = f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
        self._report(
            f"{self._stage}: {done} of {self._total} {self._unit}, about {clock} left at this pace"
        )
