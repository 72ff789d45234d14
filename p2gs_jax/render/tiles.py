"""Compositing: the dense reference, and the code that all tile rasterizers share.

A tile rasterizer is a module `rasterize_NAME` with the function `exponent_scale`, the unit of its
exponents, and a pair of functions:
`forward(rows, ids, offsets, plan)` returns the channels of the image and the transmittance, [T P]
each, and the residuals for its backward function;
`backward(rows, ids, residuals, image, v_image, plan)` returns the gradient of the rows.

Rows. A Gaussian is a row of floats: mean x, y; conic factor a11, a12, a22; log opacity; three
radiances; optionally depth. Log opacity and the plan's cutoff are divided by `exponent_scale`, the
factor by the root of twice this number. This suits the implementation's exponential: e = log
opacity - (u^2 + v^2), and alpha = exp(exponent_scale e). Row N is a dummy for padding.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from importlib import import_module
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.binning import grid_size
from p2gs_jax.render.cores import cores, gather_rows
from p2gs_jax.types import Splats2D, TileList

TileImplementation = Literal["xla", "pallas"]
DUMMY_LOG_OPACITY = -100.0  # invisible
GEOMETRY = 6  # columns of a row before its channels
# Most lanes per tile, for images too small to fill all lanes.
MOST_LANES = 8
# Compute capability of the oldest NVIDIA GPUs that Pallas supports through Triton.
AMPERE = 8.0


def rasterize_reference(
    splats: Splats2D, radiance: Float[Array, "n 3"], width: int, height: int, cfg: RenderConfig
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"]]:
    """Return radiance, alpha and alpha-weighted depth by dense compositing (paper, eq. 3).

    This is the oracle of tests: every pixel composites every Gaussian front to back, without a stop
    rule, with plain autodiff, in the precision of the input. It needs O(N H W) memory.
    """
    order = jnp.argsort(jnp.where(splats.visible, splats.depths, jnp.inf))
    s = jax.tree.map(lambda a: a[order], splats)
    x = jnp.arange(width) + 0.5
    y = jnp.arange(height) + 0.5
    dx = x[None, None, :] - s.means2d[:, 0, None, None]
    dy = y[None, :, None] - s.means2d[:, 1, None, None]
    a11, a12, a22 = (s.conic_factor[:, i, None, None] for i in range(3))
    exponent = s.log_opacities[:, None, None] - 0.5 * ((a11 * dx + a12 * dy) ** 2 + (a22 * dy) ** 2)
    alpha = jnp.where(
        exponent > float(np.log(cfg.alpha_cutoff)),
        jnp.minimum(jnp.exp(exponent), cfg.alpha_max),
        0.0,
    )
    behind = jnp.cumprod(1 - alpha, 0)
    weight = alpha * jnp.concatenate([jnp.ones_like(behind[:1]), behind[:-1]])
    return (
        jnp.einsum("nhw,nk->hwk", weight, radiance[order]),
        jnp.sum(weight, 0),
        jnp.einsum("nhw,n->hw", weight, s.depths),
    )


class Plan(NamedTuple):
    """Static sizes of one compositing run by one core."""

    across: int  # tiles across
    down: int  # rows of tiles
    lanes: int  # tiles that are composited at once (rasterize_xla.py)
    gaussians: int  # their number, which is also the row of the dummy
    channels: int  # 3, or 4 with depth
    exponent_scale: float  # of the rasterizer
    cutoff: float  # least exponent, in units of `exponent_scale`
    cfg: RenderConfig

    @property
    def tile_count(self) -> int:
        """Number of tiles."""
        return self.across * self.down

    @property
    def pixels(self) -> int:
        """Number of pixels of a tile."""
        return self.cfg.tile[0] * self.cfg.tile[1]

    def local_pixels(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Return pixel-centre offsets from the tile centre."""
        tile_x, tile_y = self.cfg.tile
        x = jnp.tile(jnp.arange(tile_x) - (tile_x - 1) / 2, tile_y)
        y = jnp.repeat(jnp.arange(tile_y) - (tile_y - 1) / 2, tile_x)
        return x.astype(jnp.float32), y.astype(jnp.float32)


def pack_rows(
    splats: Splats2D, radiance: Float[Array, "n 3"], plan: Plan
) -> Float[Array, "n1 row"]:
    """Return the rows of all Gaussians and of the dummy."""
    factor = float(np.sqrt(0.5 / plan.exponent_scale))
    columns = [
        splats.means2d,
        splats.conic_factor * factor,
        splats.log_opacities[:, None] / plan.exponent_scale,
        radiance,
    ]
    if plan.channels == 4:
        columns.append(splats.depths[:, None])
    rows = jnp.where(splats.visible[:, None], jnp.concatenate(columns, axis=1), 0.0)
    dummy = jnp.zeros((1, rows.shape[1]), rows.dtype).at[0, GEOMETRY - 1].set(DUMMY_LOG_OPACITY)
    return jnp.concatenate([rows, dummy])


def geometry_gradient(
    moments: Sequence[Array], factor: Sequence[Array], center: Sequence[Array], scale: float
) -> tuple[Array, ...]:
    """Return the gradient by the first six columns of a row, from moments over a tile.

    `moments` are the sums, over the tile's pixels, of the gradient by the exponent times 1, x, y,
    x^2, x y and y^2; x and y start at the tile's centre. `factor` is a11, a12, a22. `center` holds
    u, v, and the offsets x and y from the mean, at the tile's centre. `scale` is the plan's
    `exponent_scale`.
    """
    m1, mx, my, mxx, mxy, myy = moments
    a11, a12, a22 = factor
    u0, v0, dx0, dy0 = center
    # Moments of u and v themselves, and of u and v times the offsets.
    mu, mv = u0 * m1 + a11 * mx + a12 * my, v0 * m1 + a22 * my
    mux = u0 * mx + a11 * mxx + a12 * mxy
    muy = u0 * my + a11 * mxy + a12 * myy
    mvy = v0 * my + a22 * myy
    return (
        scale * (2 * a11 * mu),
        scale * (2 * (a12 * mu + a22 * mv)),
        scale * (-2 * (mux + dx0 * mu)),
        scale * (-2 * (muy + dy0 * mu)),
        scale * (-2 * (mvy + dy0 * mv)),
        scale * m1,
    )


def _module(name: TileImplementation):
    """Return the module of a rasterizer; Pallas is imported only if it is used."""
    return import_module(f"p2gs_jax.render.rasterize_{name}")


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _composite(rows, ids, offsets, plan: Plan, name: TileImplementation):
    return _module(name).forward(rows, ids, offsets, plan)[0]


def _composite_fwd(rows, ids, offsets, plan: Plan, name: TileImplementation):
    image, residuals = _module(name).forward(rows, ids, offsets, plan)
    return image, (rows, ids, residuals, image)


def _composite_bwd(plan: Plan, name: TileImplementation, saved, v_image):
    rows, ids, residuals, image = saved
    return _module(name).backward(rows, ids, residuals, image, v_image, plan), None, None


_composite.defvjp(_composite_fwd, _composite_bwd)


def _untile(channel, plan: Plan):
    """Return a channel [T P] as an image."""
    tile_x, tile_y = plan.cfg.tile
    grid = channel.reshape(plan.down, plan.across, tile_y, tile_x)
    return grid.transpose(0, 2, 1, 3).reshape(plan.down * tile_y, plan.across * tile_x)


def fastest_here() -> TileImplementation:
    """Return the rasterizer of the default backend: `pallas` on NVIDIA GPUs that Triton supports.

    It is called while JAX traces, so that a program contains only one variant.
    """
    if jax.default_backend() != "gpu":
        return "xla"
    try:
        capability = float(getattr(jax.devices()[0], "compute_capability", 0))
    except ValueError:  # AMD GPUs have names instead of numbers
        capability = 0.0
    return "pallas" if capability >= AMPERE else "xla"


def slow_here() -> str | None:
    """Return a note if the GPU kernels do not support this GPU, else None."""
    if jax.default_backend() == "cpu" or fastest_here() == "pallas":
        return None
    return (
        f"{jax.devices()[0].device_kind} is not an NVIDIA GPU of compute capability {AMPERE} or "
        "more: it runs the rasterizer for CPUs (xla), and may be slower than a CPU."
    )


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

    Radiance must be >= 0; the background is black. `cfg.implementation` is `reference` (dense, any
    precision, without a tile list), `xla` (lane queue), `pallas` (a GPU block per tile), or None
    for the fastest on this device. The tile list must be complete. Without `with_depth` the depth
    is None, which saves about 5 % of the work. Raises ValueError: the implementation does not
    exist, or it needs a tile list.
    """
    # The GPU kernels support single precision only.
    name = cfg.implementation or (fastest_here() if radiance.dtype == jnp.float32 else "xla")
    if name == "reference":
        linear, alpha, depth = rasterize_reference(splats, radiance, width, height, cfg)
        return linear, alpha, depth if with_depth else None
    if name not in ("xla", "pallas"):
        raise ValueError(f"{name!r} is not a valid rasterizer: choose reference, xla or pallas")
    if tiles is None:
        raise ValueError(f"the {name} rasterizer needs a tile list: pass bin_tiles(...)")
    across, down = grid_size(width, height, cfg.tile)
    down = -(-down // cores())
    pixels, scale = cfg.tile[0] * cfg.tile[1], _module(name).exponent_scale(cfg.alpha_cutoff)
    plan = Plan(
        across=across,
        down=down,
        lanes=max(1, min(cfg.pixels_in_flight // pixels, MOST_LANES * across * down)),
        gaussians=splats.depths.shape[0],
        channels=4 if with_depth else 3,
        exponent_scale=scale,
        cutoff=float(np.log(cfg.alpha_cutoff)) / scale,
        cfg=cfg,
    )
    rows = pack_rows(splats, radiance, plan)
    tiled: tuple[Array, ...] = _composite(rows, tiles.gaussian_ids, tiles.offsets, plan, name)
    whole = plan._replace(down=down * cores())
    tiled = tuple(gather_rows(a, across) for a in tiled)
    *channels, transmittance = (_untile(a, whole)[:height, :width] for a in tiled)
    depth = channels[3] if with_depth else None
    return jnp.stack(channels[:3], -1), 1 - transmittance, depth
