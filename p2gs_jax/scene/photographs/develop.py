"""HEIC, camera raw and linear light become PNG in the run's cache, once."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import platformdirs

from p2gs_jax.scene.cache import cached_folder, file_fingerprints
from p2gs_jax.scene.masks import mask_of
from p2gs_jax.scene.photographs.darkroom import NAMES, RECORD, Darkroom
from p2gs_jax.scene.photographs.kinds import Kind, kind_of
from p2gs_jax.types import Scene

# Other results: other folders.
_VERSION = 1
# Of two files of one shot, the one that says most of the light is used.
_RANK: tuple[Kind, ...] = ("exr", "float_tiff", "raw", "heif", "avif", "webp", "plain")


@dataclass(frozen=True)
class Developed:
    """Photographs in a folder that structure from motion can read.

    Attributes:
        folder: that their names are relative to.
        paths: the files in it, sorted.
        originals: what the user has, by path relative to `folder`.
        notes: what the user should know.
        known: why the response of them all is known, or None.
    """

    folder: Path
    paths: list[Path]
    originals: Mapping[str, Path]
    notes: tuple[str, ...] = ()
    known: str | None = None


def develop(
    folder: Path,
    paths: Sequence[Path],
    work_dir: Path | None,
    report: Callable[[str], None],
) -> Developed:
    """Return photographs as files that everything can read; if all are, they stay where they are.

    Args:
        folder: holds the photographs.
        paths: the photographs, in it or in its subfolders.
        work_dir: keeps what is developed; None: the user's cache.
        report: receives progress.

    Raises:
        UserError: one cannot be decoded, or a package for it is missing.
    """
    kinds, notes = _without_twins({path: kind_of(path) for path in paths})
    names = {path: path.relative_to(folder).as_posix() for path in kinds}
    if all(kind == "plain" for kind in kinds.values()):
        originals = {name: path for path, name in names.items()}
        return Developed(folder, sorted(kinds), originals, tuple(notes))
    places = {
        path: name if kinds[path] == "plain" else Path(name).with_suffix(".png").as_posix()
        for path, name in names.items()
    }
    target, said = _build(folder, kinds, places, work_dir, report)
    paths = sorted((target / place for place in places.values()), key=lambda p: p.as_posix())
    known = said["known"] if "plain" not in kinds.values() else None
    if said["known"] and not known:
        notes.append(_mixed(kinds.values()))
    originals = {place: path for path, place in places.items()}
    return Developed(target, paths, originals, (*notes, *said["notes"]), known)


def with_originals(scene: Scene, developed: Developed) -> Scene:
    """Return a scene of developed photographs with the names and notes of the user's own.

    Files that were only linked are read where they are, also beside a run that has moved.
    """
    views = []
    for view in scene.views:
        original = developed.originals[view.name]
        plain = original.suffix == Path(view.name).suffix
        name = Path(view.name).with_suffix(original.suffix).as_posix()
        path = original if plain else developed.folder / view.name
        there = dataclasses.replace(view, name=name, image_path=original)
        mask = view.mask_path or mask_of(there)
        views.append(dataclasses.replace(there, image_path=path, mask_path=mask))
    return dataclasses.replace(
        scene,
        views=tuple(views),
        notes=(*scene.notes, *developed.notes),
        known_response=developed.known,
    )


def developed_views(scene: Scene, work_dir: Path | None, report: Callable[[str], None]) -> Scene:
    """Return a scene whose views show developed photographs, where a model names others.

    Args:
        scene: as its reader returns it.
        work_dir: keeps what is developed; None: the user's cache.
        report: receives progress.

    Raises:
        UserError: one cannot be decoded, or a package for it is missing.
    """
    kinds: dict[Path, Kind] = {v.image_path: kind_of(v.image_path) for v in scene.views}
    undeveloped: dict[Path, Kind] = {path: kind for path, kind in kinds.items() if kind != "plain"}
    if not undeveloped:
        return scene
    # A suffix more keeps photographs apart that differ in theirs.
    places = {v.image_path: v.name + ".png" for v in scene.views if v.image_path in undeveloped}
    target, said = _build(scene.root, undeveloped, places, work_dir, report)
    views = tuple(
        dataclasses.replace(
            view,
            image_path=target / places[view.image_path],
            mask_path=view.mask_path or mask_of(view),
        )
        if view.image_path in places
        else view
        for view in scene.views
    )
    whole = len(undeveloped) == len(kinds)
    notes = list(said["notes"])
    if said["known"] and not whole:
        notes.append(_mixed(kinds.values()))
    return dataclasses.replace(
        scene,
        views=views,
        notes=(*scene.notes, *notes),
        known_response=said["known"] if whole else scene.known_response,
    )


def cache_of(root: Path, work_dir: Path | None) -> Path:
    """Return where files of a scene may be kept: the run's cache, or else the user's."""
    if work_dir is not None:
        return work_dir
    scene = hashlib.sha256(str(root.resolve()).encode()).hexdigest()[:16]
    return platformdirs.user_cache_path("p2gs-jax") / "photographs" / scene


def _mixed(kinds: Any) -> str:
    counts = Counter(NAMES.get(kind, "others") for kind in kinds)
    listed = ", ".join(f"{n} {name}" for name, n in counts.most_common())
    return (
        f"Photographs are of several kinds ({listed}): the tone curve is not known of all, and is "
        "chosen for all."
    )


def _without_twins(kinds: dict[Path, Kind]) -> tuple[dict[Path, Kind], list[str]]:
    """Leave out all but one file of each shot that was written twice, as raw and JPEG."""
    shots: dict[Path, list[Path]] = defaultdict(list)
    for path in kinds:
        shots[path.with_suffix("")].append(path)
    readable = {"raw": find_spec("rawpy"), "heif": find_spec("pillow_heif")}
    dropped: list[Path] = []
    for files in shots.values():
        if all(kinds[path] == "plain" for path in files):
            continue
        usable = [path for path in files if readable.get(kinds[path], True)] or files
        best = min(usable, key=lambda path: (_RANK.index(kinds[path]), path.name))
        dropped += [path for path in files if path != best]
    if not dropped:
        return kinds, []
    example = sorted(dropped)[0].name
    note = (
        f"{len(dropped)} photograph(s) are there twice, as several kinds of file ({example}, ...); "
        "of each shot one is used."
    )
    return {path: kind for path, kind in kinds.items() if path not in set(dropped)}, [note]


def _build(
    root: Path,
    kinds: Mapping[Path, Kind],
    places: Mapping[Path, str],
    work_dir: Path | None,
    report: Callable[[str], None],
) -> tuple[Path, dict[str, Any]]:
    """Fill a folder with photographs; return it and what is to be said."""
    key = {
        "version": _VERSION,
        "files": file_fingerprints(list(places)),
        "places": list(places.values()),
    }

    def build(folder: Path) -> None:
        Darkroom(kinds, report).fill(folder, places)

    with cached_folder(cache_of(root, work_dir), "developed", key, build) as folder:
        return folder, json.loads((folder / RECORD).read_text())
