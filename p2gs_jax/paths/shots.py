"""Shots: pictures to render of a fitted scene, with pose, lens, exposure and gamma."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from p2gs_jax.errors import UserError
from p2gs_jax.scene.lens import scale_intrinsics
from p2gs_jax.scene.pixels.store import camera_at
from p2gs_jax.types import Camera, View


@dataclass(frozen=True)
class Shot:
    """A pinhole camera on a path.

    Attributes:
        name: of the picture's file, without suffix; may name subfolders.
        viewmat: world-to-camera, OpenCV axes.
        K: intrinsics in pixels, pixel centres at +0.5.
        width: pixels.
        height: pixels.
        exposure_ev: stops from the geometric mean of the training exposures, or None.
        gamma: > 0, or None.
        view: row in `Scene.views` of the photograph taken there, or None.
        time: seconds: what moves is where it was then; None: it is not shown.
    """

    name: str
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    width: int
    height: int
    exposure_ev: float | None = None
    gamma: float | None = None
    view: int | None = None
    time: float | None = None

    def resized(self, width: int) -> Shot:
        """Return the shot with `width` pixels across; the height follows, rounded."""
        height = max(1, round(self.height * width / self.width))
        K = scale_intrinsics(self.K, width / self.width, height / self.height)
        return replace(self, K=K, width=width, height=height)

    def camera(self) -> Camera:
        """Return the renderer's camera."""
        viewmat, K = jnp.asarray(self.viewmat, jnp.float32), jnp.asarray(self.K, jnp.float32)
        return Camera(viewmat, K, self.width, self.height)


def view_shots(views: Sequence[View], max_width: int | None = None) -> list[Shot]:
    """Return a shot for every view of a scene, in order.

    Args:
        views: of the scene.
        max_width: pixels that a fit reduced them to, or None.
    """
    out = []
    for row, view in enumerate(views):
        K, width, height = camera_at(view, max_width)
        name = PurePosixPath(view.name).with_suffix("").as_posix()
        viewmat = np.asarray(view.viewmat, np.float64)
        K = np.asarray(K, np.float64)
        out.append(Shot(name, viewmat, K, width, height, view=row, time=view.time))
    return out


def of_camera(shots: Sequence[Shot], views: Sequence[View], camera: str | None) -> list[Shot]:
    """Return the shots that one physical camera took, in order of names.

    Args:
        shots: of the scene's views.
        views: of the scene.
        camera: which; None takes that with the most shots, the first of several.

    Raises:
        UserError: there is no such camera among them.
    """
    cameras = [views[s.view].camera for s in shots if s.view is not None]
    counts = Counter(cameras)
    if camera is None:
        camera = min(counts, key=lambda name: (-counts[name], name), default=None)
    chosen = [s for s, name in zip(shots, cameras, strict=True) if name == camera]
    if not chosen:
        known = ", ".join(sorted(counts)) or "none"
        raise UserError(f"--camera {camera!r} took none of these views.", fix=f"choose of: {known}")
    return sorted(chosen, key=lambda s: s.name)


def common_lens(shots: Sequence[Shot]) -> tuple[Float[np.ndarray, "3 3"], int, int]:
    """Return the median K of the shots that have the most common size, and that size."""
    (width, height), _ = Counter((s.width, s.height) for s in shots).most_common(1)[0]
    same = [s.K for s in shots if (s.width, s.height) == (width, height)]
    return np.median(same, axis=0), width, height
