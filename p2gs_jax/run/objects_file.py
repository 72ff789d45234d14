"""`objects.npz`: which Gaussians belong to which moving object, and corrections of their poses.

The objects themselves are in `scene.npz`. Runs in which nothing moves have no such file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Int

from p2gs_jax.core.array_files import BROKEN_ARRAYS
from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.objects import (
    KeyTimes,
    MovingObjects,
)
from p2gs_jax.types import Scene, TrackedObject


def write_objects(
    path: Path, owner: Int[np.ndarray, " n"] | None, moving: MovingObjects, scene: Scene
) -> None:
    """Write the owners of a run's Gaussians.

    Args:
        path: of the file.
        owner: of each Gaussian, a row of `moving`, -1: none; None: nothing has a box.
        moving: some of the scene's objects.
        scene: with all of them.
    """
    keys, corrections = moving.keys, moving.corrections
    arrays = {
        "owner": np.asarray([] if owner is None else owner, np.int32),
        "rows": np.array([_row(thing, scene) for thing in moving.objects], np.int32),
        "key_times": keys.first + keys.spacing * np.arange(keys.count),
    }
    if corrections is not None:
        arrays["corrections"] = np.asarray(corrections, np.float32)
    if moving.middle is not None:
        arrays["middle"] = np.asarray(moving.middle, np.float64)
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def read_objects(
    path: Path, scene: Scene, count: int
) -> tuple[Int[np.ndarray, " n"] | None, MovingObjects | None]:
    """Return what `write_objects` wrote; None where nothing moves.

    Args:
        path: of the file.
        scene: of the run.
        count: of its Gaussians.

    Raises:
        UserError: the file is broken, or belongs to another run.
    """
    if not path.is_file():
        return None, None
    try:
        with np.load(path, allow_pickle=False) as file:
            a = dict(file)
        objects = tuple(scene.objects[row] for row in a["rows"].tolist())
        times, owner = a["key_times"], a["owner"]
        spacing = float(times[1] - times[0]) if len(times) > 1 else 1.0
        keys = KeyTimes(float(times[0]), spacing, len(times))
        if "middle" in a:
            return None, MovingObjects((), keys, middle=float(a["middle"]))
        fits = len(owner) == count and owner.max(initial=-1) < len(objects)
        corrections = a.get("corrections")
        if corrections is not None:
            fits &= corrections.shape == (len(times), len(objects), 6)
    except BROKEN_ARRAYS as error:
        raise UserError(
            f"{path} cannot be read: {error}.", fix="finish the fit again with --resume"
        ) from error
    if not fits:
        raise UserError(f"{path} does not belong to this run.", fix="fit again")
    return owner, MovingObjects(objects, keys, corrections)


def _row(thing: TrackedObject, scene: Scene) -> int:
    return next(row for row, other in enumerate(scene.objects) if other is thing)
