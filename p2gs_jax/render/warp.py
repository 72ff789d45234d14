"""Warping of pixels from one view into another by rendered depth, with an occlusion test."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Bool, Float

from p2gs_jax.core.numerics import matmul, namespace
from p2gs_jax.types import Camera, Render, View

# Pixels with a larger alpha show a surface, by default.
OPAQUE = 0.95
# A surface is seen in another view if the depths differ by less than this share.
DEPTH_TOLERANCE = 0.03


class Warp(NamedTuple):
    """Positions of pixels in another view."""

    xy: Float[Array, "h w 2"]  # pixels, centres at +0.5
    seen: Bool[Array, "h w"]  # whether the other view shows the same surface there


def surface_depth(render: Render, opaque: float = OPAQUE) -> Float[Array, "h w"]:
    """Return the expected depth at pixels whose alpha is above `opaque`, and 0 elsewhere.

    Raises ValueError: the render has no depth.
    """
    if render.depth is None:
        raise ValueError("the warp needs depth: render with with_depth=True")
    surface = render.alpha > opaque
    return jnp.where(surface, render.depth / jnp.where(surface, render.alpha, 1.0), 0.0)


def unproject(depth: Float[Array | np.ndarray, "h w"], camera: Camera) -> Float[Any, "h w 3"]:
    """Return world positions of pixel centres at the given depths, camera z in scene units.

    NumPy arrays give NumPy results, in double precision.
    """
    xp = namespace(depth, camera.K)
    y, x = xp.mgrid[: camera.height, : camera.width]
    xy = xp.stack([x, y], -1) + 0.5
    focal, center = xp.diag(camera.K)[:2], camera.K[:2, 2]
    local = xp.concatenate([(xy - center) / focal, xp.ones((*depth.shape, 1))], -1)
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    return matmul(local * depth[..., None] - translation, rotation)


def project_points(
    points: Float[Array | np.ndarray, "*n 3"], camera: Camera | View
) -> tuple[Float[Any, "*n 2"], Float[Any, "*n"]]:
    """Return pixel positions (centres at +0.5) and camera z in scene units; valid for z > 1e-6.

    Pixels refer to the image size of `camera`. NumPy arrays give NumPy results.
    """
    xp = namespace(points, camera.K)
    local = matmul(points, camera.viewmat[:3, :3].T) + camera.viewmat[:3, 3]
    z = local[..., 2]
    ahead = xp.where(z > 1e-6, z, 1.0)
    return local[..., :2] / ahead[..., None] * xp.diag(camera.K)[:2] + camera.K[:2, 2], z


def visible(
    xy: Float[Array, "*n 2"], z: Float[Array, "*n"], depth: Float[Array, "h w"]
) -> Bool[Array, "*n"]:
    """Return flags of the points that lie on the surface that a view shows at their pixels.

    `xy` and `z` are the points' pixels and depths in the view; `depth` is its `surface_depth`.
    """
    height, width = depth.shape
    at = jnp.floor(xy).astype(jnp.int32)
    x, y = at[..., 0], at[..., 1]
    inside = (z > 1e-6) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    surface = depth[jnp.where(inside, y, 0), jnp.where(inside, x, 0)]
    return inside & (surface > 0) & (jnp.abs(surface - z) < DEPTH_TOLERANCE * z)


def warp(
    depth: Float[Array, "h w"],
    camera: Camera,
    other_depth: Float[Array, "h2 w2"],
    other_camera: Camera,
) -> Warp:
    """Return the positions of one view's pixels in another view (docs/photometry.md, 3, w(u)).

    The depths are from `surface_depth`.
    """
    xy, z = project_points(unproject(depth, camera), other_camera)
    return Warp(xy, (depth > 0) & visible(xy, z, other_depth))


def sample_bilinear(image: Float[Array, "h w c"], xy: Float[Array, "*n 2"]) -> Float[Array, "*n c"]:
    """Return the image at pixel positions (centres at +0.5), clamped to the border."""
    row_and_column = [xy[..., 1] - 0.5, xy[..., 0] - 0.5]
    channel = partial(map_coordinates, coordinates=row_and_column, order=1, mode="nearest")
    return jax.vmap(channel, -1, -1)(image)
