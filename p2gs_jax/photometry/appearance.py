"""Corrections of display values per view, as published baselines learn them beside the splats.

`affine`: a 3x4 colour matrix per view (the 3DGS code's exposure compensation). `bilateral`: a grid
of such matrices over the image and luminance (bilateral-guided radiance fields). `curve`: one
rising curve per view for all channels (in the manner of Luminance-GS). Parameters are deviations:
zeros change nothing.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.config import Appearance
from p2gs_jax.core.numerics import on_device
from p2gs_jax.types import LUMINANCE

# Luminance levels, rows and columns of a bilateral grid, as its authors use.
GRID = (8, 16, 16)
CURVE_KNOTS = 16


def identity(kind: Appearance, views: int) -> Float[Array, "v ..."]:
    """Return parameters that change nothing."""
    shapes = {"affine": (3, 4), "bilateral": (12, *GRID), "curve": (CURVE_KNOTS,)}
    return on_device(np.zeros((views, *shapes[kind])))


def corrected(
    ldr: Float[Array, "h w 3"], parameters: Float[Array, "..."], kind: Appearance
) -> Float[Array, "h w 3"]:
    """Return display values as one view shows them.

    Args:
        ldr: rendered display values.
        parameters: of that view.
        kind: which correction.
    """
    if kind == "affine":
        return ldr + ldr @ parameters[:, :3].T + parameters[:, 3]
    if kind == "curve":
        return _curve(ldr, parameters)
    return _bilateral(ldr, parameters)


def _curve(ldr: Float[Array, "h w 3"], raw: Float[Array, " k"]) -> Float[Array, "h w 3"]:
    """Piecewise linear with slopes exp(raw): always rising; the last piece goes on above 1."""
    count = raw.shape[0]
    slopes = jnp.exp(raw)
    starts = jnp.concatenate([jnp.zeros(1), jnp.cumsum(slopes)[:-1]]) / count
    place = jnp.clip(jnp.floor(ldr * count), 0, count - 1).astype(jnp.int32)
    return starts[place] + (ldr - place / count) * slopes[place]


def _bilateral(ldr: Float[Array, "h w 3"], grid: Float[Array, "12 d y x"]) -> Float[Array, "h w 3"]:
    """Slice by matrix products and hat functions: dense, so that its gradient is as well."""
    height, width, _ = ldr.shape
    levels, rows, columns = grid.shape[1:]
    up = jnp.einsum("cdyx,hy->cdhx", grid, jnp.asarray(_hats(height, rows), ldr.dtype))
    up = jnp.einsum("cdhx,wx->cdhw", up, jnp.asarray(_hats(width, columns), ldr.dtype))
    guide = jnp.clip(ldr @ jnp.asarray(LUMINANCE, ldr.dtype), 0.0, 1.0) * (levels - 1)
    hats = jnp.maximum(1.0 - jnp.abs(guide - jnp.arange(levels)[:, None, None]), 0.0)
    matrix = jnp.sum(up * hats, 1).reshape(3, 4, height, width)
    return ldr + jnp.einsum("ijhw,hwj->hwi", matrix[:, :3], ldr) + matrix[:, 3].transpose(1, 2, 0)


def _hats(pixels: int, cells: int) -> np.ndarray:
    """Return linear interpolation weights from cells to pixels, corners aligned."""
    at = np.linspace(0.0, cells - 1.0, pixels)[:, None]
    return np.maximum(1.0 - np.abs(at - np.arange(cells)), 0.0)


def roughness(parameters: Float[Array, "v ..."], kind: Appearance) -> Float[Array, ""]:
    """Return the mean squared difference of neighbouring cells of bilateral grids; else 0."""
    if kind != "bilateral":
        return jnp.zeros(())
    return sum((jnp.mean(jnp.diff(parameters, axis=k) ** 2) for k in (2, 3, 4)), jnp.zeros(()))
