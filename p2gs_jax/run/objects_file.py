"""`objects.npz`: which Gaussians belong to which moving object.

The objects themselves are in `scene.npz`. Runs in which nothing moves have no such file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Int

from p2gs_jax.core.array_files import BROKEN_ARRAYS
from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.moving import MovingObjects
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
    arrays = {
        "owner": np.asarray([] if owner is None else owner, np.int32),
        "rows": np.array([_row(thing, scene) for thing in moving.objects], np.int32),
    }
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
        owner = a["owner"]
        if "middle" in a:
            return None, MovingObjects((), middle=float(a["middle"]))
        fits = len(owner) == count and owner.max(initial=-1) < len(objects)
    except BROKEN_ARRAYS as error:
        raise UserError(
            f"{path} cannot be read: {error}.", fix="finish the fit again with --resume"
        ) from error
    if not fits:
        raise UserError(f"{path} does not belong to this run.", fix="fit again")
    return owner, MovingObjects(objects)


def _row(thing: TrackedObject, scene: Scene) -> int:
    return next(row for row, other in enumerate(scene.objects) if other is thing)
