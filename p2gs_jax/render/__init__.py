"""Rendering: one pure function from Gaussians and a camera to linear HDR radiance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.binning import bin_tiles, count_entries
from p2gs_jax.render.project import at_time, camera_of_each, project, view_radiance
from p2gs_jax.render.tiles import (
    TileImplementation,
    rasterize_reference,
    rasterize_tiles,
    with_cutoffs,
)
from p2gs_jax.types import Camera, Gaussians, Render, Splats2D, TileList

# The oldest NVIDIA GPUs that Pallas supports through Triton.
AMPERE = 8.0

__all__ = [
    "bin_tiles",
    "count_entries",
    "fastest_here",
    "project",
    "rasterize",
    "render_linear",
    "render_splats",
    "required_capacity",
    "view_radiance",
]


def rasterize(
    splats: Splats2D,
    radiance: Float[Array, "n 3"],
    tiles: TileList | None,
    width: int,
    height: int,
    cfg: RenderConfig,
    with_depth: bool = True,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"] | None]:
    """Composite splats of linear HDR radiance into radiance, alpha and alpha-weighted depth.

    Radiance is >= 0. `cfg.implementation` is `reference` (dense, any precision, without a tile
    list), `xla` (lane queue), `pallas` (a GPU block per tile), or None for the fastest that runs
    here. Without depth there is None in its place, and about 5 % less work.

    Raises:
        ValueError: no such implementation, or one of tiles without a tile list.
    """
    name = cfg.implementation or fastest_here()
    if name == "reference":
        linear, alpha, depth = rasterize_reference(splats, radiance, width, height, cfg)
        return linear, alpha, depth if with_depth else None
    if name not in ("xla", "pallas"):
        raise ValueError(f"there is no rasterizer {name!r}; choose 'reference', 'xla' or 'pallas'")
    if tiles is None:
        raise ValueError(f"the {name} rasterizer needs a tile list: pass bin_tiles(...)")
    return rasterize_tiles(splats, radiance, tiles, width, height, cfg, name, with_depth)


def fastest_here() -> TileImplementation:
    """Return the rasterizer of the default backend: `pallas` on NVIDIA GPUs that Triton knows.

    Called while tracing, so that a program contains one of them only.
    """
    if jax.default_backend() != "gpu":
        return "xla"
    capability = getattr(jax.devices()[0], "compute_capability", None)
    return "pallas" if capability is not None and float(capability) >= AMPERE else "xla"


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

    A render whose `overflow` is set must be discarded and the `capacity` of the tile lists grown,
    see `required_capacity`. `owner` is the moving object of each Gaussian (`Population.owner`);
    `active_degree` is the highest spherical-harmonics degree in use, None for all.
    """
    if gaussians.capacity == 0:
        return _nothing(camera, cfg, with_depth)
    gaussians = at_time(gaussians, camera.objects)
    of_each = camera_of_each(camera, owner)
    splats = project(gaussians, alive, of_each, cfg)
    radiance = view_radiance(gaussians, of_each, cfg, active_degree)
    return render_splats(splats, radiance, camera, cfg, capacity, with_depth=with_depth)


def render_splats(
    splats: Splats2D,
    radiance: Float[Array, "n 3"],
    camera: Camera,
    cfg: RenderConfig,
    capacity: int,
    *,
    with_depth: bool = True,
) -> Render:
    """Render Gaussians that are projected already; see `render_linear`."""
    splats = with_cutoffs(splats, radiance, cfg)
    if cfg.implementation == "reference":
        tiles, count = None, jnp.int32(0)
        overflow = jnp.array(False)
    else:
        tiles = bin_tiles(splats, camera.width, camera.height, capacity, cfg)
        count, overflow = tiles.count, tiles.overflow
    linear, alpha, depth = rasterize(
        splats, radiance, tiles, camera.width, camera.height, cfg, with_depth
    )
    linear = _over_background(linear, alpha, cfg)
    return Render(linear, alpha, depth, count, overflow, splats.visible)


def required_capacity(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    camera: Camera,
    cfg: RenderConfig,
    owner: Int[Array, " n"] | None = None,
) -> Int[Array, ""]:
    """Return the exact tile-list capacity one view needs; arguments as of `render_linear`."""
    if gaussians.capacity == 0:
        return jnp.int32(0)
    gaussians = at_time(gaussians, camera.objects)
    camera = camera_of_each(camera, owner)
    splats = project(gaussians, alive, camera, cfg)
    if cfg.cutoff_rule == "radiance":
        splats = with_cutoffs(splats, view_radiance(gaussians, camera, cfg), cfg)
    return count_entries(splats, camera.width, camera.height, cfg)


def _over_background(
    linear: Float[Array, "h w 3"], alpha: Float[Array, "h w"], cfg: RenderConfig
) -> Float[Array, "h w 3"]:
    """Return radiance with that of the background, where it shows through."""
    if cfg.background is None:
        return linear
    return linear + (1 - alpha)[..., None] * jnp.asarray(cfg.background, linear.dtype)


def _nothing(camera: Camera, cfg: RenderConfig, with_depth: bool) -> Render:
    blank = jnp.zeros((camera.height, camera.width))
    return Render(
        linear=_over_background(jnp.zeros((*blank.shape, 3)), blank, cfg),
        alpha=blank,
        depth=blank if with_depth else None,
        count=jnp.int32(0),
        overflow=jnp.array(False),
        visible=jnp.zeros(0, bool),
    )
