"""Moving objects that Gaussians belong to, and where they are in a view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from p2gs_jax.core.numerics import on_host
from p2gs_jax.errors import UserError
from p2gs_jax.render.project import HIDDEN
from p2gs_jax.scene.rigid import interpolated
from p2gs_jax.types import Placement, Scene, TrackedObject

MOST_LISTED = 12


@dataclass(frozen=True)
class MovingObjects:
    """The objects that Gaussians belong to.

    Attributes:
        objects: in the order of `Population.owner`.
        offsets: by which somebody moved them, in the frame of each box, scene units; None: nobody.
        middle: of the drive, where Gaussians vibrate: the zero of `Placement.time`, seconds.
    """

    objects: tuple[TrackedObject, ...]
    offsets: Float[np.ndarray, "k 3"] | None = None
    middle: float | None = None

    def __len__(self) -> int:
        return len(self.objects)

    def poses(self, time: float) -> tuple[Float64[np.ndarray, "k 4 4"], Bool[np.ndarray, " k"]]:
        """Return box-to-world matrices at a time, and which objects are tracked then."""
        out = np.tile(np.eye(4), (len(self), 1, 1))
        there = np.zeros(len(self), bool)
        for row, thing in enumerate(self.objects):
            poses, covered = interpolated(thing.times, thing.poses, np.array([time]))
            out[row], there[row] = poses[0], covered[0]
        if self.offsets is not None:
            out[:, :3, 3] += np.einsum("kij,kj->ki", out[:, :3, :3], self.offsets)
        return out, there

    def moved(self, name: str, offset: Sequence[float]) -> MovingObjects:
        """Return the objects with one of them moved.

        Args:
            name: of its track, or how that begins.
            offset: forward, left and up in the frame of its box, scene units.

        Raises:
            UserError: no object has this name, or several.
        """
        names = [thing.name for thing in self.objects]
        exact = [row for row, known in enumerate(names) if known == name]
        found = exact or [row for row, known in enumerate(names) if known.startswith(name)]
        if len(found) != 1 or not name:
            what = "no object" if not found else f"{len(found)} objects"
            listed = ", ".join(f"{o.name} ({o.label})" for o in self.objects[:MOST_LISTED])
            rest = len(self.objects) - MOST_LISTED
            raise UserError(
                f"{what} with Gaussians of its own has a name that begins with {name!r}.",
                fix=f"choose of {listed}" + (f" and {rest} others" if rest > 0 else ""),
            )
        offsets = np.zeros((len(self), 3)) if self.offsets is None else self.offsets.copy()
        offsets[found[0]] += np.asarray(offset, float)
        return dataclasses.replace(self, offsets=offsets)

    def placement(self, viewmat: Float[np.ndarray, "4 4"], time: float) -> Placement:
        """Return where the objects are in a view, on the host.

        Args:
            viewmat: of the view, world-to-camera.
            time: seconds.
        """
        poses, there = self.poses(time)
        viewmats = (np.asarray(viewmat, np.float64) @ poses).astype(np.float32)
        viewmats[~there] = HIDDEN
        since = None if self.middle is None else np.float32(time - self.middle)
        return on_host(Placement, viewmats, since)


def middle_time(scene: Scene) -> float:
    """Return the time of the middle one of the training views that have one, seconds."""
    times = sorted(view.time for view in scene.training_views if view.time is not None)
    return times[len(times) // 2]
