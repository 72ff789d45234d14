"""Which views are held out: every n-th of each physical camera, as 3DGS does; of a drive every n-th
frame for all cameras."""

from __future__ import annotations

import dataclasses
from collections import defaultdict

from p2gs_jax.errors import UserError
from p2gs_jax.types import View


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
