"""Binning: which Gaussians each tile composites, in depth order, without a per-tile cap.

No gradients flow here. Two implementations: `counting`, sequential and linear, for CPUs; `sorting`,
data-parallel, for everything else. `RenderConfig.binning` None takes the device's.
"""

from __future__ import annotations

import jax
from jax import lax
from jaxtyping import Array, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.binning import counting, sorting
from p2gs_jax.types import Splats2D, TileList

_WAYS = {"counting": counting, "sorting": sorting}


def _choose(name: str, splats: Splats2D, cfg: RenderConfig, *static):
    splats = jax.tree.map(lax.stop_gradient, splats)

    def way(module):
        return lambda s: getattr(module, name)(s, *static, cfg)

    if cfg.binning is not None:
        return way(_WAYS[cfg.binning])(splats)
    return lax.platform_dependent(splats, cpu=way(counting), default=way(sorting))


def count_entries(splats: Splats2D, width: int, height: int, cfg: RenderConfig) -> Int[Array, ""]:
    """Return the tile-list capacity this view needs, at most 2^30."""
    return _choose("count_entries", splats, cfg, width, height)


def bin_tiles(
    splats: Splats2D, width: int, height: int, capacity: int, cfg: RenderConfig
) -> TileList:
    """List the Gaussians of every tile in depth order.

    A tile gets a Gaussian only if its ellipse at the alpha cutoff reaches a pixel centre of it.

    Args:
        splats: the view's splats (gradients are not used).
        width: image width, pixels.
        height: image height, pixels.
        capacity: entries the list can hold; see `count_entries`.
        cfg: tile size, alpha cutoff, way of binning.

    Returns:
        The list; if `overflow` is set it is incomplete and must not be composited.
    """
    return _choose("bin_tiles", splats, cfg, width, height, capacity)
