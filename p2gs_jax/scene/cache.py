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


def stage_progress(
    report: Report, stage: str, total: int, unit: str, clock: Callable[[], float] = time.monotonic
) -> Callable[[int], None]:
    """Begin a stage, such as "matching" 100 "image pairs"; return what reports how many are done.

    The first message comes at once, others now and then.
    """
    begin = last = clock()
    if total:
        report(f"{stage}: {total} {unit}")

    def progress(done: int) -> None:
        nonlocal last
        now = clock()
        if now - last < EVERY_S or not 0 < done < total:
            return
        last = now
        minutes, seconds = divmod(round((now - begin) / done * max(total - done, 0)), 60)
        hours, minutes = divmod(minutes, 60)
        left = f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
        report(f"{stage}: {done} of {total} {unit}, about {left} left at this pace")

    return progress
