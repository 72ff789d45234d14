"""Rendering: one pure function from Gaussians and a camera to linear HDR radiance."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.binning import bin_tiles, count_entries
from p2gs_jax.render.project import at_time, camera_of_each, project
from p2gs_jax.render.tiles import rasterize
from p2gs_jax.render.visible import splat
from p2gs_jax.types import Camera, Gaussians, Render, Splats2D


def render_linear(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    camera: Camera,
    cfg: RenderConfig,
    capacity: int,
    *,
    owner: Int[Array, " n"] | None = None,
    active_degree: Int[Array, ""] | int | None = None,
    with_depth: bool = True,
) -> Render:
    """Render linear HDR radiance of one view (paper, eq. 3).

    `capacity` is the length of the tile list (`required_capacity`). If `overflow` is set, discard
    the render and grow the capacity. `owner` is the moving object of each Gaussian
    (`Population.owner`); `active_degree` is the highest spherical-harmonics degree in use, None for
    all.
    """
    if gaussians.capacity == 0:
        return _empty_render(camera, cfg, with_depth)
    shown = splat(gaussians, alive, camera, cfg, active_degree, owner)
    return render_splats(*shown, camera, cfg, capacity, with_depth=with_depth)


def render_splats(
    splats: Splats2D,
    radiance: Float[Array, "n 3"],
    camera: Camera,
    cfg: RenderConfig,
    capacity: int,
    *,
    with_depth: bool = True,
) -> Render:
    """Render Gaussians that are already projected; see `render_linear`."""
    size, tiles = (camera.width, camera.height), None
    count, overflow = jnp.int32(0), jnp.array(False)
    if cfg.implementation != "reference":
        tiles = bin_tiles(splats, *size, capacity, cfg)
        count, overflow = tiles.count, tiles.overflow
    linear, alpha, depth = rasterize(splats, radiance, tiles, *size, cfg, with_depth)
    linear = _over_background(linear, alpha, cfg)
    return Render(linear, alpha, depth, count, overflow, splats.visible)


def required_capacity(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    camera: Camera,
    cfg: RenderConfig,
    owner: Int[Array, " n"] | None = None,
) -> Int[Array, ""]:
    """Return the exact tile-list capacity that a view needs; for arguments see `render_linear`."""
    if gaussians.capacity == 0:
        return jnp.int32(0)
    gaussians = at_time(gaussians, camera.objects)
    camera = camera_of_each(camera, owner)
    splats = project(gaussians, alive, camera, cfg)
    return count_entries(splats, camera.width, camera.height, cfg)


def _over_background(
    linear: Float[Array, "h w 3"], alpha: Float[Array, "h w"], cfg: RenderConfig
) -> Float[Array, "h w 3"]:
    """Return radiance composited over the background of `cfg`, if there is one."""
    if cfg.background is None:
        return linear
    return linear + (1 - alpha)[..., None] * jnp.asarray(cfg.background, linear.dtype)


def _empty_render(camera: Camera, cfg: RenderConfig, with_depth: bool) -> Render:
    blank = jnp.zeros((camera.height, camera.width))
    linear = _over_background(jnp.zeros((*blank.shape, 3)), blank, cfg)
    rest = jnp.int32(0), jnp.array(False), jnp.zeros(0, bool)
    return Render(linear, blank, blank if with_depth else None, *rest)
