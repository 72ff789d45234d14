"""Tile by tile, whatever the implementation: the plan, the gradient's frame, the image.

An implementation is a module with a pair of functions and its exponent's unit:
`forward(rows, ids, offsets, plan)` gives the channels of the image and the transmittance, [T P]
each, and what its own backward needs;
`backward(rows, ids, residuals, image, v_image, plan)` gives the gradient of the rows.
"""

from __future__ import annotations

import functools
from importlib import import_module
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.binning.boxes import grid_size
from p2gs_jax.render.cutoff import smallest_cutoff
from p2gs_jax.render.tile_rows import Plan, pack_rows
from p2gs_jax.types import Splats2D, TileList

# Lanes for every tile of an image too small to fill them.
MOST_LANES = 8

TileImplementation = Literal["xla", "pallas"]


def _module(name: TileImplementation):
    """Return the module; Pallas is imported only where it is used."""
    return import_module(f"p2gs_jax.render.rasterize_{name}")


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _composite(rows, ids, offsets, plan: Plan, name: TileImplementation):
    return _module(name).forward(rows, ids, offsets, plan)[0]


def _composite_fwd(rows, ids, offsets, plan: Plan, name: TileImplementation):
    image, own = _module(name).forward(rows, ids, offsets, plan)
    return image, (rows, ids, own, image)


def _composite_bwd(plan: Plan, name: TileImplementation, residuals, v_image):
    rows, ids, own, image = residuals
    return _module(name).backward(rows, ids, own, image, v_image, plan), None, None


_composite.defvjp(_composite_fwd, _composite_bwd)


def _untile(channel, plan: Plan):
    """Return a channel [T P] as an image."""
    grid = channel.reshape(plan.down, plan.across, plan.tile_y, plan.tile_x)
    return grid.transpose(0, 2, 1, 3).reshape(plan.down * plan.tile_y, plan.across * plan.tile_x)


def rasterize_tiles(
    splats: Splats2D,
    radiance: Float[Array, "n 3"],
    tiles: TileList,
    width: int,
    height: int,
    cfg: RenderConfig,
    implementation: TileImplementation,
    with_depth: bool = True,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"] | None]:
    """Composite splats tile by tile.

    Args:
        splats: projected Gaussians.
        radiance: linear HDR radiance of each, >= 0.
        tiles: the tile list of this view; must not have overflowed.
        width: image width, pixels.
        height: image height, pixels.
        cfg: tile, chunk, lanes, cutoff, termination.
        implementation: which rasterizer.
        with_depth: composite depth too.

    Returns:
        Linear radiance (black background), alpha, and alpha-weighted depth or None.
    """
    tile_x, tile_y = cfg.tile
    across, down = grid_size(width, height, cfg.tile)
    smallest = smallest_cutoff(cfg)
    plan = Plan(
        across=across,
        down=down,
        tile_x=tile_x,
        tile_y=tile_y,
        lanes=max(1, min(cfg.pixels_in_flight // (tile_x * tile_y), MOST_LANES * across * down)),
        chunk=cfg.chunk,
        gaussians=splats.depths.shape[0],
        channels=4 if with_depth else 3,
        exponent_scale=_module(implementation).exponent_scale(smallest),
        log_cutoff=float(np.log(smallest)),
        own_cutoffs=cfg.cutoff_rule == "radiance",
        alpha_max=cfg.alpha_max,
        stop_error=cfg.stop_error,
        exp_degree=cfg.exp_degree,
        deterministic=cfg.deterministic,
    )
    rows = pack_rows(splats, radiance, plan)
    tiled: tuple[Array, ...] = _composite(
        rows, tiles.gaussian_ids, tiles.offsets, plan, implementation
    )
    *channels, transmittance = (_untile(a, plan)[:height, :width] for a in tiled)
    depth = channels[3] if with_depth else None
    return jnp.stack(channels[:3], -1), 1 - transmittance, depth
