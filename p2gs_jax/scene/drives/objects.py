"""Tracked things, the same way for every data set."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from p2gs_jax.types import TrackedObject

# Boxes of parked cars jump by a few decimetres from frame to frame; what gets further moves.
STANDS_WITHIN_M = 1.0


def tracked(
    name: str,
    label: str,
    size: tuple[float, float, float],
    times: Sequence[float] | Float64[np.ndarray, " k"],
    poses: Sequence[Float64[np.ndarray, "4 4"]] | Float64[np.ndarray, "k 4 4"],
    moving: bool | None,
) -> TrackedObject:
    """Return a track in the order of its times, each time once.

    Args:
        name: of the track.
        label: what it is, in the data set's words.
        size: length (x), width (y), height (z) of the box, metres.
        times: seconds, in any order; of repeated ones the first counts.
        poses: box to world, the origin in the middle of the box; at least one.
        moving: what the set says; None: it moves if it gets further than a metre from where it
            was first.
    """
    at, rows = np.unique(np.asarray(times, np.float64), return_index=True)
    ordered = np.asarray(poses, np.float64).reshape(-1, 4, 4)[rows]
    if moving is None:
        positions = ordered[:, :3, 3]
        away = np.linalg.norm(positions - positions[0], axis=1)
        moving = bool(away.max() > STANDS_WITHIN_M)
    length, width, height = (float(side) for side in size)
    return TrackedObject(name, label, (length, width, height), at, ordered, moving)


class Box(NamedTuple):
    """One box around a thing, at one time.

    Attributes:
        track: name of the thing.
        label: what it is.
        size: length (x), width (y), height (z), metres.
        time: seconds.
        pose: box to world.
        moving: what the set says of this moment, or None.
    """

    track: str
    label: str
    size: tuple[float, float, float]
    time: float
    pose: Float64[np.ndarray, "4 4"]
    moving: bool | None = None


def tracks(boxes: Iterable[Box]) -> tuple[TrackedObject, ...]:
    """Return the things that boxes belong to, by their names.

    The size of a thing is the median of its boxes. It moves if it does in one of them.
    """
    of: dict[str, list[Box]] = {}
    for box in boxes:
        of.setdefault(box.track, []).append(box)
    things = []
    for name, own in sorted(of.items()):
        told = [box.moving for box in own if box.moving is not None]
        length, width, height = np.median([box.size for box in own], axis=0)
        things.append(
            tracked(
                name,
                own[0].label,
                (length, width, height),
                [box.time for box in own],
                [box.pose for box in own],
                any(told) if told else None,
            )
        )
    return tuple(things)
