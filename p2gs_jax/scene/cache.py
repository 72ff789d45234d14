"""Results of long computations, kept in the run folder for a resume."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from p2gs_jax.core.atomic import write_text

_MARKER = "finished"


@contextmanager
def cached_folder(
    work_dir: Path | None, name: str, key: object, build: Callable[[Path], None]
) -> Iterator[Path]:
    """Provide a folder that `build` has filled, now or in an earlier run.

    The folder counts as finished once a marker with the hash of `key` has been moved into it; one
    that was interrupted half-way, or made from other inputs, is emptied and filled again.

    Args:
        work_dir: where the folder lives; None uses a temporary one, gone after the `with` block.
        name: of the folder.
        key: JSON-serialisable; everything the result depends on.
        build: fills the empty folder it is given.
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
