"""Cameras of stored views, ready for the renderer."""

from __future__ import annotations

from p2gs_jax.core.numerics import on_device
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Camera


def camera_of(store: ImageStore, index: int, shrink: float = 1.0) -> Camera:
    """Return the camera of view `index` at the resolution that `store.get` gives it."""
    viewmat, K, width, height = store.camera(index, shrink)
    return Camera(on_device(viewmat), on_device(K), width, height, store.placement(index))
