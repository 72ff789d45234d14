"""Moving objects that Gaussians belong to, and where they are in a view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.core.numerics import on_host
from p2gs_jax.errors import UserError
from p2gs_jax.render.project import HIDDEN
from p2gs_jax.scene.rigid import interpolated
from p2gs_jax.types import Params, Placement, Scene, TrackedObject

# Key times lie this many poses of a track apart: between two of them are several photographs, so
# that one which is held out finds its correction learned by others.
POSES_PER_KEY = 2
# Where no track has two poses.
DEFAULT_SPACING_S = 0.2
MOST_LISTED = 12


@dataclass(frozen=True)
class KeyTimes:
    """Evenly spaced times at which corrections of poses are kept.

    Attributes:
        first: seconds.
        spacing: seconds.
        count: how many.
    """

    first: float
    spacing: float
    count: int

    def at(self, time: float) -> tuple[int, float]:
        """Return the row of the key time before a time, and the share of the way to the next."""
        along = float(np.clip((time - self.first) / self.spacing, 0, self.count - 1))
        row = min(int(along), max(self.count - 2, 0))
        return row, along - row


@dataclass(frozen=True)
class MovingObjects:
    """The objects that Gaussians belong to.

    Attributes:
        objects: in the order of `Population.owner`.
        keys: of the rows of `corrections`.
        corrections: `Params.poses` of a finished fit; None: poses are as they were tracked, or the
            fit that learns them is not finished.
        offsets: by which somebody moved them, in the frame of each box, scene units; None: nobody.
        middle: of the drive, where Gaussians vibrate: the zero of `Placement.time`, seconds.
    """

    objects: tuple[TrackedObject, ...]
    keys: KeyTimes
    corrections: Float[np.ndarray, "t k 6"] | None = None
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
        if self.corrections is not None:
            out = out @ _moves(self.corrections, *self.keys.at(time))
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
        key, share = self.keys.at(time)
        since = None if self.middle is None else np.float32(time - self.middle)
        return on_host(Placement, viewmats, np.int32(key), np.float32(share), since)


def key_times(objects: Sequence[TrackedObject], times: Sequence[float]) -> KeyTimes:
    """Return key times about as dense as the tracks are, over the times that views have.

    Args:
        objects: tracked.
        times: of the views, seconds.
    """
    gaps = np.concatenate([np.zeros(0), *(np.diff(thing.times) for thing in objects)])
    spacing = POSES_PER_KEY * float(np.median(gaps)) if len(gaps) else DEFAULT_SPACING_S
    first, last = min(times), max(times)
    return KeyTimes(first, spacing, int(np.ceil((last - first) / spacing - 1e-6)) + 1)


def fitted_objects(moving: MovingObjects | None, params: Params) -> MovingObjects | None:
    """Return the objects of a finished fit, with the corrections of their poses."""
    if moving is None or params.poses is None:
        return moving
    return dataclasses.replace(moving, corrections=np.asarray(params.poses))


def middle_time(scene: Scene) -> float:
    """Return the time of the middle one of the training views that have one, seconds."""
    times = sorted(view.time for view in scene.training_views if view.time is not None)
    return times[len(times) // 2]


def _moves(corrections: Float[np.ndarray, "t k 6"], key: int, share: float) -> np.ndarray:
    """Return corrections at a time as matrices; as `render.objects.corrected` has them."""
    last = len(corrections) - 1
    before, after = (corrections[min(row, last)].astype(np.float64) for row in (key, key + 1))
    small = before + share * (after - before)
    out = np.tile(np.eye(4), (len(small), 1, 1))
    half = np.concatenate([0.5 * small[:, :3], np.ones((len(small), 1))], 1)
    out[:, :3, :3] = Rotation.from_quat(half).as_matrix()
    out[:, :3, 3] = small[:, 3:]
    return out
