"""Cameras of stored views, ready for the renderer."""

from __future__ import annotations

import jax.numpy as jnp

from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Camera


def camera_of(store: ImageStore, index: int, shrink: float = 1.0) -> Camera:
    """Return the camera of view `index` at the resolution that `store.get` gives it."""
    viewmat, K, width, height = store.camera(index, shrink)
    return Camera(jnp.asarray(viewmat), jnp.asarray(K), width, height)
