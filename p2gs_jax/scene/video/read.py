"""From a video to a folder of photographs in the run's cache."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import write_text
from p2gs_jax.errors import UserError
from p2gs_jax.scene.cache import cached_folder, file_fingerprints
from p2gs_jax.scene.photographs.develop import Developed, cache_of
from p2gs_jax.scene.photographs.files import write_png
from p2gs_jax.scene.video.choose import Chosen, choose_frames, thinned
from p2gs_jax.scene.video.frames import VIDEO_SUFFIXES, expected_frames, frames_of, no_frames
from p2gs_jax.scene.video.motion import WIDTH

RECORD = "frames.json"
_VERSION = 1
_TRANSFER_NAMES = {"hlg": "HLG video", "pq": "PQ video"}


def is_video(path: Path) -> bool:
    """Return whether a file counts as a video, by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def read_video(
    path: Path, cfg: DataConfig, work_dir: Path | None, report: Callable[[str], None]
) -> Developed:
    """Return the chosen frames of a video as photographs.

    Args:
        path: of the video.
        cfg: `every` and `max_frames`.
        work_dir: keeps the frames; None: the user's cache.
        report: receives progress.

    Raises:
        UserError: it is no video, holds none, changes its size, or shows too little.
    """
    key = {
        "version": _VERSION,
        "file": file_fingerprints([path]),
        "every": cfg.every,
        "max_frames": cfg.max_frames,
    }

    def build(folder: Path) -> None:
        _build(path, cfg, folder, report)

    with cached_folder(cache_of(path, work_dir), "video", key, build) as folder:
        said = json.loads((folder / RECORD).read_text())
    paths = [folder / frame["file"] for frame in said["frames"]]
    originals = {file.name: file for file in paths}
    return Developed(folder, paths, originals, tuple(said["notes"]), said["known"])


def _build(path: Path, cfg: DataConfig, folder: Path, report: Callable[[str], None]) -> None:
    expected = expected_frames(path)
    seen = 0

    def watched() -> Iterator[tuple[int, np.ndarray]]:
        nonlocal seen
        for frame in frames_of(path):
            if seen % 100 == 0:
                of = "" if expected is None else f" of {expected}"
                report(f"looking through the video: frame {frame.number}{of}")
            seen += 1
            yield frame.number, frame.grey(WIDTH)

    if cfg.every is None:
        found = choose_frames(watched())
    else:
        found = [Chosen(n, 0.0, None) for n, _ in watched() if n % cfg.every == 0]
    if seen < 2:
        raise no_frames(path, seen)
    by_number = {one.number: one for one in found}
    numbers = thinned(list(by_number), cfg.max_frames)
    notes = [_said(seen, len(found), len(numbers), cfg)]
    if expected is not None and seen < expected - 2:
        notes.append(f"The video breaks off: {seen} of {expected} frames could be decoded.")
    if len(numbers) < 2:
        raise UserError(
            f"{path}: {len(numbers)} of {seen} frames would be used; a scene needs several, taken "
            "from different places.",
            fix="film while walking around the thing, or take frames by number with --every",
        )
    records, transfers = _write(path, set(numbers), by_number, folder, report)
    if transfers - {None} and None in transfers:
        notes.append("The transfer function changes within the video: its curve is not known.")
    known = None if None in transfers else ", ".join(_TRANSFER_NAMES[t] for t in sorted(transfers))  # type: ignore[index, type-var]
    said = {"known": known, "notes": notes, "frames": records}
    write_text(folder / RECORD, json.dumps(said, indent=1))


def _write(
    path: Path,
    wanted: set[int],
    chosen: dict[int, Chosen],
    folder: Path,
    report: Callable[[str], None],
) -> tuple[list[dict], set[str | None]]:
    records: list[dict] = []
    transfers: set[str | None] = set()
    for frame in frames_of(path):
        if frame.number not in wanted:
            continue
        if len(records) % 10 == 0:
            report(f"keeping frames: {len(records)} of {len(wanted)}")
        name = f"{frame.number:06d}.png"
        write_png(folder / name, frame.codes())
        transfers.add(frame.transfer)
        one = chosen[frame.number]
        way = None if one.way is None else vars(one.way)
        records.append(
            {
                "file": name,
                "frame": frame.number,
                "time": round(frame.time, 6),
                "turn": 90 * frame.turn,
                "sharpness": one.sharpness,
                "way": way,
            }
        )
        if len(records) == len(wanted):
            break
    return records, transfers


def _said(seen: int, found: int, kept: int, cfg: DataConfig) -> str:
    how = (
        "sharp ones, each from a new place"
        if cfg.every is None
        else "all of them"
        if cfg.every == 1
        else f"every {cfg.every}th"
    )
    thin = f", thinned from {found} (--max-frames)" if kept < found else ""
    return f"Of {seen} frames of the video {kept} are used: {how}{thin}."
