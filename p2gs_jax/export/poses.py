"""The pose files of a scene, written to another folder that holds new photographs.

COLMAP models go to `sparse/0`, their photographs to `images`; the files of all other formats keep
their place. Files are copied byte for byte, unless the photographs they name have another suffix,
or masks are added. Poses, lenses and points never change.
"""

from __future__ import annotations

import copy
import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.text import first_few
from p2gs_jax.errors import UserError
from p2gs_jax.scene.colmap import find_deeper_model, find_model, read_model
from p2gs_jax.scene.files import IMAGE_SUFFIXES, alike_names, read_json
from p2gs_jax.scene.transforms import FIX, llff_table, relative_name
from p2gs_jax.types import Scene

_STEMS = ("cameras", "images", "points3D", "rigs", "frames")
_MODEL = (*(f"{stem}.{kind}" for stem in _STEMS for kind in ("bin", "txt")), "points3D.ply")
# Lists of held-out photographs beside a model, or in the scene's folder.
_LISTS = ("train.txt", "test.txt")
_FRAMES = ("frames", "test_frames")
_NAMES_IN_JSON = ("train_filenames", "val_filenames", "test_filenames")
# Sizes in COLMAP's images.bin, bytes: an image up to its name, and a keypoint.
_BEFORE_NAME, _KEYPOINT = 64, 24


@dataclass(frozen=True)
class Poses:
    """The pose files of a scene, and its photographs as these name them."""

    files: Mapping[str, Path]  # by their place in the new folder
    stated: Mapping[str, str]  # name of each view's photograph in the files, by the view's name
    base: str = "images"  # subfolder of the new folder to which the names are relative

    def places(self, suffixes: Sequence[str], other: str) -> dict[str, str]:
        """Return the place of each view's photograph in the new folder.

        A name keeps its suffix if it is one of `suffixes`, and has the suffix `other` otherwise.
        """
        out, used = dict[str, str](), set[str]()

        def suffix_of(view: str) -> str:
            return _suffix(self.stated[view]) or PurePosixPath(view).suffix

        # Names that stay come first, so that no other photograph gets one of them.
        for view in sorted(self.stated, key=lambda view: suffix_of(view).lower() not in suffixes):
            stated, suffix = self.stated[view], suffix_of(view)
            stem = PurePosixPath(self.base, stated.removesuffix(_suffix(stated))).as_posix()
            place = stem + (suffix if suffix.lower() in suffixes else other)
            # Photographs whose names differ only by suffix get different places.
            out[view] = place if place not in used else f"{stem}-{suffix[1:]}{other}"
            used.add(out[view])
        return {view: out[view] for view in self.stated}

    def notes(self, places: Mapping[str, str]) -> list[str]:
        """Return a note on photographs with another suffix than in the scene's files, if any."""
        other = [p for v, p in places.items() if _suffix(self.stated[v]) not in ("", _suffix(p))]
        note = f"{len(other)} photographs have another suffix than their originals, in the files "
        return [f"{note}with the poses too: {first_few(other)}."] if other else []

    def write(self, folder: Path, places: Mapping[str, str], masks: Mapping[str, str]) -> None:
        """Write the files to a folder; photographs and masks are at these places, by view."""
        names = {self.stated[view]: place for view, place in places.items()}
        relative = {old: place.removeprefix("images/") for old, place in names.items()}
        for place, path in self.files.items():
            data = path.read_bytes()
            if path.suffix == ".json":
                by_name = {self.stated[view]: mask for view, mask in masks.items()}
                data = _json(path, data, names, by_name, folder)
            elif any(old != new for old, new in relative.items()):
                if path.name == "images.bin":
                    data = _binary(data, relative)
                elif path.suffix == ".txt" and path.stem in ("images", "train", "test"):
                    data = _text(data.decode("utf-8-sig"), relative).encode()
            write_if_new(folder / place, data)


def poses_of(scene: Scene, cache: Path) -> Poses:
    """Return the pose files of a scene; `cache` has the model made for photographs without poses.

    Raises UserError: the scene is of a format that other programs do not read.
    """
    root, names = scene.root, [view.name for view in scene.views]
    if scene.format in ("colmap", "images"):
        model = cache / "sfm" / "model" if scene.format == "images" else None
        model = model or find_model(root) or find_deeper_model(root)
        assert model is not None
        files = {name: root / name for name in _LISTS}
        files |= {f"sparse/0/{name}": model / name for name in (*_MODEL, *_LISTS)}
        stated = [image.name for image in read_model(model).images]
        existing = {place: path for place, path in files.items() if path.is_file()}
        return Poses(existing, _by_view(stated, names))
    if scene.format in ("transforms", "blender"):
        if scene.format == "blender":
            parts = [root / f"transforms_{part}.json" for part in ("train", "test", "val")]
            found = [path for path in parts if path.is_file()][:2]
        else:
            found = [root if root.is_file() else root / "transforms.json"]
        stated = [_plain(p, f["file_path"]) for p in found for f in _frames(read_json(p, FIX))]
        return Poses({path.name: path for path in found}, _by_view(stated, names), base="")
    table = llff_table(root)
    if scene.format == "llff" and table is not None:
        return Poses({table.name: table}, {name: name for name in names})
    why = f"{root} is a scene of the format {scene.format!r}: no other trainer reads its cameras."
    fix = "leave out --develop, or fit the scene and use `p2gs-jax export RUN --format colmap`"
    raise UserError(why, fix=fix)


def write_if_new(path: Path, data: bytes) -> None:
    """Write a file atomically, unless it has this content already."""
    if not (path.is_file() and path.read_bytes() == data):
        with atomic_write(path) as temporary:
            temporary.write_bytes(data)


def _suffix(name: str) -> str:
    """Return the suffix of an image file, or "": Blender's names have no suffix."""
    suffix = PurePosixPath(name).suffix
    return suffix if suffix.lower() in IMAGE_SUFFIXES else ""


def _frames(data: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for key in _FRAMES:
        yield from data.get(key) or ()


def _plain(source: Path, name: str) -> str:
    """Return a name in the file `source` relative to its folder, which it never leaves."""
    return "/".join(part for part in relative_name(source, name).parts if part != "..")


def _by_view(stated: Sequence[str], views: Sequence[str]) -> dict[str, str]:
    """Return the name of each view in the pose files, which may begin with more folders."""
    best: dict[str, str] = {}
    parts = {name: PurePosixPath(name).parts for name in stated}
    for depth in range(max(map(len, parts.values()))):
        tails = {"/".join(folders[depth:]): name for name, folders in parts.items()}
        found = {view: tails[tail] for tail, view in alike_names(tails, views).items()}
        best = max(best, found, key=len)
    return best


def _json(
    path: Path, data: bytes, names: Mapping[str, str], masks: Mapping[str, str], folder: Path
) -> bytes:
    """Return a transforms.json with other names and masks; copy other files that it names."""
    before = read_json(path, FIX)
    content, new = copy.deepcopy(before), dict[str, str]()
    for key in _FRAMES:
        if content.get(key):  # photographs may be missing if the user allows it
            content[key] = [f for f in content[key] if _plain(path, f["file_path"]) in names]
    for frame in _frames(content):
        name = frame["file_path"]
        stated = _plain(path, name)
        place = names[stated]
        same = place == stated if _suffix(stated) else place.startswith(f"{stated}.")
        if not same or os.path.isabs(name) or ".." in Path(name).parts:
            new[stated] = frame["file_path"] = place
        frame.pop("mask_path", None)
        frame |= {"mask_path": masks[stated]} if masks else {}
    for key in content.keys() & set(_NAMES_IN_JSON):
        content[key] = [new.get(_plain(path, name), name) for name in content[key]]
    for key, value in [(k, v) for part in (content, *_frames(content)) for k, v in part.items()]:
        named = key.endswith("_path") and key not in ("file_path", "mask_path")
        if named and isinstance(value, str) and (path.parent / value).is_file():
            write_if_new(folder / _plain(path, value), (path.parent / value).read_bytes())
    return data if content == before else json.dumps(content, indent=2).encode() + b"\n"


def _binary(data: bytes, new: Mapping[str, str]) -> bytes:
    """Return COLMAP's images.bin with other names."""
    out, at = [data[:8]], 8
    for _ in range(int.from_bytes(data[:8], "little")):
        end = data.index(b"\0", at + _BEFORE_NAME)
        stop = end + 9 + _KEYPOINT * struct.unpack_from("<Q", data, end + 1)[0]
        name = data[at + _BEFORE_NAME : end].decode().replace("\\", "/")
        out += [data[at : at + _BEFORE_NAME], new.get(name, name).encode(), data[end:stop]]
        at = stop
    return b"".join(out)


def _text(text: str, new: Mapping[str, str]) -> str:
    """Return COLMAP's images.txt (10 fields per image) or a list of names, with other names."""
    out = []
    for line in text.splitlines():
        name = line.split(maxsplit=9)[-1] if len(line.split(maxsplit=9)) == 10 else line.strip()
        known = new.get(name.strip().replace("\\", "/"))
        out.append(line if known is None else line[: len(line) - len(name)] + known)
    return "\n".join(out) + "\n"
