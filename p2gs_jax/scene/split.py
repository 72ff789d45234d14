"""Held-out views: listed by the user or the data set, or else every n-th view of each camera.

All views of an exposure bracket are held out together.

    FILE.json            {"train": ["a.png", ...], "test": ["b.png", ...]}; a missing list is the
                         rest of the views; `val` is held out if there is no `test`
    test.txt, train.txt  one name a line (3DGS reads test.txt beside a COLMAP model); empty lines
                         and lines that begin with # do not count

A name is the view's name, or any end of the path of its photograph, with or without the suffix.
"""

from __future__ import annotations

import dataclasses
import glob
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import first_few, natural
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.brackets import brackets
from p2gs_jax.scene.exposures import plain_name, row_finder
from p2gs_jax.scene.files import read_json
from p2gs_jax.scene.masks import image_folder_of
from p2gs_jax.types import Scene, Tracks, View

EVERY = "every"
_INSTEAD = "--split every holds out every n-th view instead"


def split_scene(scene: Scene, cfg: DataConfig) -> Scene:
    """Return a scene with held-out views and the rule that chose them (`split_by`).

    A file that the user names comes first, then the data set's split (`split_by` and the views),
    then every n-th view. If `test_every` is 0, no view is held out. Raises UserError: the file is
    broken or names a missing photograph, or the number of held-out views is impossible.
    """
    if cfg.split is not None and cfg.split != EVERY and cfg.test_every:
        lists = read_split(Path(cfg.split))
        return split_as_listed(scene, lists, allow_missing=cfg.allow_missing)
    if scene.split_by is not None and cfg.split != EVERY and cfg.test_every:
        return scene
    n = cfg.test_every
    views = assign_split(scene.views, n)
    if any(view.frame is not None for view in views):
        unit = "frame"
    else:
        unit = "bracket" if n and len({*brackets(views)}) < len(views) else "view"
        unit += " of each camera"
    ending = "th" if 10 <= n % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    by = f"every {n}{ending} {unit}" if n else "--test-every 0"
    return dataclasses.replace(scene, views=views, split_by=by)


def check_every(test_every: int) -> None:
    """Raise UserError: every n-th view cannot be held out, because n is negative or 1."""
    if test_every < 0 or test_every == 1:
        why = f"--test-every {test_every} is not valid."
        raise UserError(why, fix="use 0 (hold out none) or a number from 2 on; 8 is usual")


def assign_split(views: tuple[View, ...], test_every: int) -> tuple[View, ...]:
    """Return the views with `split` set, in their order.

    Views 0, n, 2n, ... of each camera, sorted by the numbers in names, are `test`, as in 3DGS. The
    views of an exposure bracket count as one. If views have frames, the frames 0, n, 2n, ... of the
    scene are `test`. No view is held out if n is 0, or if its camera would have no training view.
    Raises UserError: n is negative, or 1.
    """
    check_every(test_every)
    test: set[int] = set()
    if test_every:
        by_camera: dict[str, list[int]] = defaultdict(list)
        for i in sorted(range(len(views)), key=lambda i: natural(views[i].name)):
            by_camera[views[i].camera].append(i)
        frames = sorted({v.frame for v in views if v.frame is not None})
        picked, bracket = set(frames[::test_every]), [] if frames else brackets(views)
        for rows in by_camera.values():
            if frames:
                chosen = {i for i in rows if views[i].frame in picked}
            else:
                held_out = {*[*dict.fromkeys(bracket[i] for i in rows)][::test_every]}
                chosen = {i for i in rows if bracket[i] in held_out}
            if len(chosen) < len(rows):
                test.update(chosen)
    return _with_test(views, test)


def _with_test(views: Sequence[View], test: set[int]) -> tuple[View, ...]:
    return tuple(
        dataclasses.replace(v, split="test" if i in test else "train") for i, v in enumerate(views)
    )


class SplitLists(NamedTuple):
    """Names of photographs that are trained on or held out; None stands for the rest of the views.

    `where` is the file with the lists, or the folder and the names of several files.
    """

    where: Path
    train: Sequence[str] | None = None
    test: Sequence[str] | None = None


def read_split(path: Path) -> SplitLists:
    """Read a user's lists: .json, or a text file with the names of held-out photographs.

    Raises UserError: the file is absent, or holds no such lists.
    """
    if not path.exists():
        raise broken(path, "does not exist", "correct the option --split")
    if path.suffix.lower() != ".json":
        return SplitLists(path, test=_lines(path))
    data = read_json(path, "correct the file")
    found = lists_in(path, data, {name: name for name in ("train", "test", "val")})
    if found is None:
        fix = 'write {"train": [NAME, ...], "test": [NAME, ...]}, or one of the two'
        raise broken(path, 'has no list "test" and no list "train"', fix)
    return found


def lists_in(path: Path, data: object, keys: dict[str, str]) -> SplitLists | None:
    """Return the lists in the data of a .json, or None if it holds none.

    `keys` maps `train`, `test` and `val` to the file's keys. `val` is held out if `test` is absent
    or empty, and left out otherwise. Raises UserError: a value is not a list of names.
    """
    lists: dict[str, list[str]] = {}
    for name, key in keys.items():
        names = data.get(key) if isinstance(data, dict) else None
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(n, str) and n for n in names):
            raise broken(f"{path}:", f'"{key}" is not a list of names', "correct the file")
        lists[name] = names
    # Tools write empty lists for parts of the split that they lack.
    held_out = lists.get("test") or lists.get("val") or None
    return SplitLists(path, lists.get("train"), held_out) if lists else None


def lists_beside(*folders: Path) -> SplitLists | None:
    """Return the lists in `train.txt` and `test.txt` of the first folder that has one of them."""
    for folder in folders:
        train, test = folder / "train.txt", folder / "test.txt"
        if found := [path for path in (train, test) if path.is_file()]:
            where = folder / " and ".join(path.name for path in found)
            return SplitLists(where, *(_lines(p) if p in found else None for p in (train, test)))
    return None


def split_as_listed(scene: Scene, lists: SplitLists, *, allow_missing: bool = False) -> Scene:
    """Return a scene whose views are split by lists; views in neither list are left out.

    Raises UserError: a name belongs to no photograph (unless `allow_missing`) or to several, or is
    in both lists; or no training view is left.
    """
    views, where, name, notes = scene.views, lists.where, lists.where.name, []
    row_of = row_finder(views, where)
    found = [
        None if names is None else {n: row_of(n) for n in names}
        for names in (lists.train, lists.test)
    ]
    unused = [n for rows in found for n, row in (rows or {}).items() if row is None]
    if unused:
        absent = [n for n in unused if not _exists_without_pose(n, views)]
        if absent and not allow_missing:
            why = f"lists {absent[0]}, which the scene does not have"
            raise broken(where, why, f"correct the name, or add the photograph; {_INSTEAD}")
        why = f"{name} lists {len(unused)} photographs that are not views of the scene"
        notes.append(f"{why}: {first_few(unused)}")
    all_rows = set(range(len(views)))
    train, test = (
        None if rows is None else {row for row in rows.values() if row is not None}
        for rows in found
    )
    train = all_rows - (test or set()) if train is None else train
    test = all_rows - train if test is None else test
    if both := sorted(train & test):
        why = f"{views[both[0]].name} is both trained on and held out"
        raise broken(f"{where}:", why, f"remove it from one of the lists; {_INSTEAD}")
    if not train:
        raise broken(where, "leaves no view to train on", f"correct the lists; {_INSTEAD}")
    scene = dataclasses.replace(scene, views=_with_test(views, test), split_by=name)
    if left := sorted(all_rows - train - test):
        why = f"{len(left)} views are neither trained on nor held out by {name}"
        notes.append(f"{why}: they are not used")
        scene = only(scene, sorted(train | test))
    if not test:
        why = f"{name} holds out no view, so the quality of new views is not measured."
        notes.append(f"{why} --split every holds out every n-th view.")
    return dataclasses.replace(scene, notes=(*scene.notes, *notes))


def only(
    scene: Scene, rows: Sequence[int] | np.ndarray, points: Int[np.ndarray, " k"] | None = None
) -> Scene:
    """Return a scene with the views in `rows`, points (None: all), and their observations."""
    points = np.arange(len(scene.points)) if points is None else points
    view, point = (np.full(len(a), -1, np.int32) for a in (scene.views, scene.points))
    view[rows], point[points] = np.arange(len(rows)), np.arange(len(points))
    tracks, colors = scene.tracks, scene.point_colors
    if tracks is not None:
        seen_in, seen = view[tracks.view_indices], point[tracks.point_indices]
        left = (seen_in >= 0) & (seen >= 0)
        tracks = Tracks(seen_in[left], seen[left], tracks.xy[left])
    return dataclasses.replace(
        scene,
        views=tuple(scene.views[i] for i in rows),
        points=scene.points[points],
        point_colors=None if colors is None else colors[points],
        tracks=tracks,
    )


def _lines(path: Path) -> tuple[str, ...]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        fix = "write one name a line, or a .json with lists"
        raise broken(path, "is not a text file", fix) from None
    names = (line.strip() for line in text.splitlines())
    found = tuple(name for name in names if name and not name.startswith("#"))
    if not found:
        raise broken(path, "names no photograph", "write one name a line")
    return found


def _exists_without_pose(name: str, views: Sequence[View]) -> bool:
    path = image_folder_of(views[0]) / plain_name(name)
    return path.is_file() or (
        path.parent.is_dir() and any(path.parent.glob(glob.escape(path.name) + ".*"))
    )
