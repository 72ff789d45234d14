"""Features and matches that stay: photographs that are added later meet those that are there.

The database outlives what is made of it: another mapper, an interruption or ten photographs more
cost only what is new. It is thrown away where a photograph changed or is gone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import pycolmap

from p2gs_jax.core.atomic import write_json
from p2gs_jax.scene.cache import file_fingerprints
from p2gs_jax.scene.features import MAX_FEATURES, MAX_IMAGE_SIZE, Pair, extract, match, quotable
from p2gs_jax.scene.pace import Pace

DATABASE, RECORD = "database.db", "photographs.json"
# Photographs and pairs between two messages.
IMAGES_AT_ONCE, PAIRS_AT_ONCE = 8, 100


def kept_features(
    folder: Path,
    image_folder: Path,
    groups: Mapping[tuple, Sequence[str]],
    report: Callable[[str], None],
) -> Path:
    """Return a database with the features of all photographs, of which some may be there already.

    Args:
        folder: keeps it.
        image_folder: what names are relative to.
        groups: names of the photographs by what those of one camera have in common.
        report: receives progress.

    Raises:
        UserError: COLMAP failed.
    """
    record = _record(image_folder, groups)
    database = folder / DATABASE
    if not _continues(folder / RECORD, record):
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / RECORD, record)
    names = [name for group in groups.values() for name in group]
    known = _cameras(database)
    new = [name for name in names if name not in known]
    if len(new) < len(names):
        report(f"features of {len(names) - len(new)} images are kept from an earlier run")
    pace, done = Pace(report, "detecting features", len(new), "images"), 0
    for group in groups.values():
        wanted = [name for name in group if name not in known]
        for start in range(0, len(wanted), IMAGES_AT_ONCE):
            part = wanted[start : start + IMAGES_AT_ONCE]
            camera = next((known[name] for name in group if name in known), None)
            mode = pycolmap.CameraMode.SINGLE
            extract(database, image_folder, part, mode=mode, camera=camera)
            known |= _cameras(database)
            done += len(part)
            pace(done)
    return database


def match_kept(
    database: Path,
    names: Sequence[str],
    pairs: Sequence[Pair] | None,
    report: Callable[[str], None],
) -> int:
    """Match what is not matched yet; return how many pairs there are in all.

    Args:
        database: with features.
        names: of the photographs.
        pairs: names of the images to match; None: every pair.
        report: receives progress.
    """
    wanted = list(combinations(sorted(names), 2)) if pairs is None else list(pairs)
    if not quotable(names):
        report(f"matching: {len(wanted)} image pairs")
        match(database, pairs)
        return len(wanted)
    left = _unmatched(database, wanted)
    if len(left) < len(wanted):
        report(f"matches of {len(wanted) - len(left)} image pairs are kept from an earlier run")
    pace = Pace(report, "matching", len(left), "image pairs")
    for start in range(0, len(left), PAIRS_AT_ONCE):
        match(database, left[start : start + PAIRS_AT_ONCE])
        pace(start + PAIRS_AT_ONCE)
    return len(wanted)


def _record(image_folder: Path, groups: Mapping[tuple, Sequence[str]]) -> dict:
    """Return what the features depend on, as JSON has it."""
    files = {}
    for key, group in groups.items():
        prints = file_fingerprints([image_folder / name for name in group])
        for name, (_, size, changed) in zip(group, prints, strict=True):
            files[name] = [size, changed, str(key)]
    options = [pycolmap.__version__, MAX_IMAGE_SIZE, MAX_FEATURES]
    return {"options": options, "files": files}


def _continues(path: Path, record: dict) -> bool:
    """Whether the photographs of an earlier run are among those of this, unchanged."""
    try:
        old = json.loads(path.read_text())
        now = record["files"]
        return old["options"] == record["options"] and all(
            now.get(name) == said for name, said in old["files"].items()
        )
    except (OSError, ValueError, KeyError, AttributeError):
        return False


def _cameras(database: Path) -> dict[str, int]:
    """Return the camera of every photograph that has features."""
    if not database.is_file():
        return {}
    db = pycolmap.Database.open(database)
    try:
        return {
            image.name: image.camera_id
            for image in db.read_all_images()
            if db.exists_keypoints(image.image_id)
        }
    finally:
        db.close()


def _unmatched(database: Path, pairs: Sequence[Pair]) -> list[Pair]:
    """Return the pairs of photographs with features that were never matched."""
    db = pycolmap.Database.open(database)
    try:
        ids = {image.name: image.image_id for image in db.read_all_images()}
        return [
            (a, b)
            for a, b in pairs
            if a in ids and b in ids and not db.exists_two_view_geometry(ids[a], ids[b])
        ]
    finally:
        db.close()
