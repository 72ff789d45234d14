"""Which views are held out: as the user or the data set says, else every n-th of each physical
camera, as 3DGS does; of a drive every n-th frame for all cameras."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from pathlib import Path

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.split_lists import read_split, split_as_listed
from p2gs_jax.types import Scene, View

EVERY = "every"


def split_scene(scene: Scene, cfg: DataConfig) -> Scene:
    """Return a scene whose views are split, and that says by what.

    A file that the user names comes first, then what the data set says, then every n-th view;
    `test_every` 0 holds out none in any case.

    Args:
        scene: as it was read; where the data set decides, `split_by` and the views say so.
        cfg: `split` and `test_every`.

    Raises:
        UserError: the file is broken or names what is not there, or so many cannot be held out.
    """
    if cfg.split is not None and cfg.split != EVERY and cfg.test_every:
        lists = read_split(Path(cfg.split))
        return split_as_listed(scene, lists, allow_missing=cfg.allow_missing)
    if scene.split_by is not None and cfg.split != EVERY and cfg.test_every:
        return scene
    views = assign_split(scene.views, cfg.test_every)
    what = "frame" if any(view.frame is not None for view in views) else "view of each camera"
    told = f"every {_ordinal(cfg.test_every)} {what}" if cfg.test_every else "--test-every 0"
    return dataclasses.replace(scene, views=views, split_by=told)


def _ordinal(n: int) -> str:
    ending = "th" if 10 <= n % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{ending}"


def assign_split(views: tuple[View, ...], test_every: int) -> tuple[View, ...]:
    """Return the views with `split` set.

    Within each camera, sorted by name, views 0, n, 2n, ... are `test`; where views have frames,
    the frames 0, n, 2n, ... among all of them are. A camera that would be left without a training
    view holds out none.

    Args:
        views: all views, in any order; the order is kept.
        test_every: n; 0 holds out none.

    Raises:
        UserError: n is negative, or 1, which would leave nothing to train on.
    """
    if test_every < 0 or test_every == 1:
        raise UserError(
            f"cannot hold out every n-th view with n = {test_every}",
            fix="use 0 (hold out none) or a number from 2 on; 8 is usual",
        )
    if not test_every:
        return tuple(dataclasses.replace(v, split="train") for v in views)
    by_camera: dict[str, list[int]] = defaultdict(list)
    for i in sorted(range(len(views)), key=lambda i: views[i].name):
        by_camera[views[i].camera].append(i)
    frames = sorted({v.frame for v in views if v.frame is not None})
    held_out = set(frames[::test_every])
    test: set[int] = set()
    for rows in by_camera.values():
        chosen = {i for i in rows if views[i].frame in held_out} if frames else rows[::test_every]
        if len(chosen) < len(rows):
            test.update(chosen)
    return tuple(
        dataclasses.replace(v, split="test" if i in test else "train") for i, v in enumerate(views)
    )
