"""Lists of what is trained on and what is held out, as data sets and users write them.

    FILE.json            {"train": ["a.png", ...], "test": ["b.png", ...]}; one of them may be
                         missing: it is then the rest. `val` is held out where there is no `test`
    test.txt, train.txt  names, a line each (3DGS reads test.txt beside a COLMAP model); empty lines
                         and those that begin with # do not count

A name is that of the view, or any end of the path of its photograph, with or without the suffix.
"""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.types import Scene, Tracks, View

LISTS = ("train", "test", "val")
TEXT_FILES = {"train": "train.txt", "test": "test.txt"}
_WITHOUT = "--split every holds out every n-th view instead"


@dataclasses.dataclass(frozen=True)
class SplitLists:
    """Names of photographs.

    Attributes:
        source: the file, or the files, in words.
        folder: that it is, or they are, in.
        train: what is trained on; None: the rest.
        test: what is held out; None or empty: `val` if there is one, else the rest.
        val: held out by others while they train; here it takes the place of `test` or is left out.
    """

    source: str
    folder: Path
    train: tuple[str, ...] | None = None
    test: tuple[str, ...] | None = None
    val: tuple[str, ...] | None = None

    @property
    def where(self) -> str:
        """The file, or the files, with their folder."""
        return str(self.folder / self.source)


def read_split(path: Path) -> SplitLists:
    """Read the lists that a user names: .json, or text with the names of what is held out.

    Raises:
        UserError: it is not there, or holds no such lists.
    """
    if path.suffix.lower() != ".json":
        return SplitLists(path.name, path.parent, test=_lines(path))
    try:
        said = parse_json(_text(path))
    except json.JSONDecodeError as error:
        raise UserError(
            f"{path} is not valid JSON: {error.msg} in line {error.lineno}, column {error.colno}",
            fix="correct the file",
        ) from None
    found = lists_in(path, said, {name: name for name in LISTS})
    if found is None:
        raise UserError(
            f'{path} has no list "test" and no list "train"',
            fix='write {"train": [NAME, ...], "test": [NAME, ...]}, or one of the two',
        )
    return found


def lists_in(path: Path, said: object, keys: dict[str, str]) -> SplitLists | None:
    """Return the lists that a parsed .json holds, or None where it holds none.

    Args:
        path: of the file.
        said: what it holds.
        keys: what `train`, `test` and `val` are called in it.

    Raises:
        UserError: one of them is no list of names.
    """
    lists: dict[str, tuple[str, ...]] = {}
    for name, key in keys.items():
        given = said.get(key) if isinstance(said, dict) else None
        if given is None:
            continue
        if not isinstance(given, list) or not all(isinstance(n, str) and n for n in given):
            raise UserError(f'{path}: "{key}" is no list of names', fix="correct the file")
        lists[name] = tuple(given)
    return SplitLists(path.name, path.parent, **lists) if lists else None


def lists_beside(*folders: Path) -> SplitLists | None:
    """Return the lists in `train.txt` and `test.txt` of the first folder that has one of them."""
    for folder in folders:
        files = {name: folder / file for name, file in TEXT_FILES.items()}
        found = {name: path for name, path in files.items() if path.is_file()}
        if found:
            source = " and ".join(path.name for path in found.values())
            names = {name: _lines(path) for name, path in found.items()}
            return SplitLists(source, folder, **names)
    return None


def split_as_listed(scene: Scene, lists: SplitLists, *, allow_missing: bool = False) -> Scene:
    """Return a scene whose views are split as lists say; what is in none of them is left out.

    Args:
        scene: as it was read.
        lists: which views are which.
        allow_missing: names that no photograph has are left out instead of an error.

    Raises:
        UserError: a name belongs to no photograph, or to several; it is in two lists; or nothing is
            left to train on.
    """
    views, notes, unused = scene.views, [], []
    rows_of = _rows_by_name(views)
    # Tools write empty lists for what they have not.
    held = lists.test or lists.val or None
    rows: dict[str, set[int]] = {}
    for part, names in (("train", lists.train), ("test", held)):
        if names is None:
            continue
        found = [_row(name, views, rows_of, lists, unused) for name in names]
        rows[part] = {row for row in found if row is not None}
    if unused:
        registered = [n for n in unused if not _lies_there(n, views)]
        said = f"{lists.source} lists {len(unused)} photographs that are no views of the scene: "
        said += ", ".join(unused[:5]) + (", ..." if len(unused) > 5 else "")
        if registered and not allow_missing:
            raise UserError(
                f"{lists.where} lists {registered[0]}, which the scene does not have",
                fix=f"correct the name, or add the photograph; {_WITHOUT}",
            )
        notes.append(said)
    everything = set(range(len(views)))
    train = rows.get("train", everything - rows.get("test", set()))
    test = rows.get("test", everything - train)
    both = sorted(train & test)
    if both:
        raise UserError(
            f"{lists.where}: {views[both[0]].name} is both trained on and held out",
            fix=f"take it out of one of the lists; {_WITHOUT}",
        )
    if not train:
        raise UserError(
            f"{lists.where} leaves no view to train on", fix=f"correct the lists; {_WITHOUT}"
        )
    split = [
        dataclasses.replace(v, split="test" if i in test else "train") for i, v in enumerate(views)
    ]
    scene = dataclasses.replace(scene, views=tuple(split), split_by=lists.source)
    left = sorted(everything - train - test)
    if left:
        notes.append(
            f"{len(left)} views are neither trained on nor held out by {lists.source}: they are "
            "not used"
        )
        scene = without_views(scene, left)
    if not test:
        notes.append(
            f"{lists.source} holds no view out: nothing says how good views are that are not "
            "trained on. --split every holds out every n-th."
        )
    return dataclasses.replace(scene, notes=(*scene.notes, *notes))


def without_views(scene: Scene, rows: Sequence[int]) -> Scene:
    """Return a scene without some of its views and their observations.

    Args:
        scene: as it was.
        rows: of the views to leave out.
    """
    kept = np.setdiff1d(np.arange(len(scene.views)), np.asarray(rows, int))
    tracks = scene.tracks
    if tracks is not None:
        place = np.full(len(scene.views), -1)
        place[kept] = np.arange(len(kept))
        seen = place[tracks.view_indices] >= 0
        tracks = Tracks(
            place[tracks.view_indices[seen]].astype(tracks.view_indices.dtype),
            tracks.point_indices[seen],
            tracks.xy[seen],
        )
    return dataclasses.replace(scene, views=tuple(scene.views[i] for i in kept), tracks=tracks)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(f"{path} does not exist", fix="correct the option --split") from None
    except (OSError, UnicodeDecodeError):
        raise UserError(
            f"{path} is no text file", fix="write one name a line, or a .json with lists"
        ) from None


def _lines(path: Path) -> tuple[str, ...]:
    names = (line.strip() for line in _text(path).splitlines())
    found = tuple(name for name in names if name and not name.startswith("#"))
    if not found:
        raise UserError(f"{path} names no photograph", fix="write one name a line")
    return found


def _plain(name: str) -> str:
    return name.removesuffix(Path(name).suffix)


def _normal(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).as_posix()


def _rows_by_name(views: Sequence[View]) -> dict[str, set[int]]:
    """Return the views that each end of a path may mean, with and without its suffix."""
    rows: dict[str, set[int]] = defaultdict(set)
    for row, view in enumerate(views):
        parts = view.image_path.as_posix().lstrip("/").split("/")
        for start in range(len(parts)):
            tail = "/".join(parts[start:])
            rows[tail].add(row)
            rows[tail.removesuffix(view.image_path.suffix)].add(row)
    return rows


def _row(
    name: str,
    views: Sequence[View],
    rows_of: dict[str, set[int]],
    lists: SplitLists,
    unused: list[str],
) -> int | None:
    """Return the view of a name; one that has none is noted down."""
    normal = _normal(name)
    rows = rows_of.get(normal.lstrip("/"), set())
    exact = {row for row in rows if normal in (views[row].name, _plain(views[row].name))}
    rows = exact if len(exact) == 1 else rows
    if len(rows) > 1:
        names = " and ".join(views[row].name for row in sorted(rows)[:2])
        raise UserError(
            f"{lists.where}: {name} may be {names}", fix="write more of the path into the list"
        )
    if not rows:
        unused.append(name)
        return None
    return next(iter(rows))


def _lies_there(name: str, views: Sequence[View]) -> bool:
    """Return whether a photograph is there of which the scene has no pose."""
    folder = views[0].image_path
    for _ in Path(views[0].name).parts:
        folder = folder.parent
    path = folder / _normal(name)
    return path.is_file() or (path.parent.is_dir() and any(path.parent.glob(f"{path.name}.*")))
