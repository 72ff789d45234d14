"""What the tile rasterizers share: the static plan, rows of floats, the closed-form gradient.

Rows. A Gaussian is a row of floats: mean x, y; conic factor a11, a12, a22; log opacity; three
radiances; depth if asked for; its own log cutoff if they differ. Factor, opacity and cutoff are
divided by the plan's `exponent_scale` (the factor by its root), in the units that suit an
implementation's exponential: e = log opacity - (u^2 + v^2) and alpha = exp(exponent_scale e).
Row N is a dummy that absorbs padding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.types import Splats2D

DUMMY_LOG_OPACITY = -100.0
GEOMETRY = 6  # columns of a row before its channels
# Floor of a pixel's brightness in the stop rule, over the brightest splat
# (RenderConfig.stop_error).
DARKEST = 1e-4


class Plan(NamedTuple):
    """Static shape of one compositing run."""

    across: int
    down: int
    tile_x: int
    tile_y: int
    lanes: int
    chunk: int
    gaussians: int
    channels: int
    exponent_scale: float
    log_cutoff: float
    own_cutoffs: bool
    alpha_max: float
    stop_error: float | None
    exp_degree: int | None
    deterministic: bool

    @property
    def tile_count(self) -> int:
        """Tiles of the image."""
        return self.across * self.down

    @property
    def pixels(self) -> int:
        """Pixels of a tile."""
        return self.tile_x * self.tile_y

    def local_pixels(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Return pixel-centre offsets from the tile centre."""
        x = jnp.tile(jnp.arange(self.tile_x) - (self.tile_x - 1) / 2, self.tile_y)
        y = jnp.repeat(jnp.arange(self.tile_y) - (self.tile_y - 1) / 2, self.tile_x)
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
    if plan.own_cutoffs:
        columns.append(splats.log_cutoffs[:, None] / plan.exponent_scale)
    rows = jnp.where(splats.visible[:, None], jnp.concatenate(columns, axis=1), 0.0)
    dummy = jnp.zeros((1, rows.shape[1]), rows.dtype).at[0, GEOMETRY - 1].set(DUMMY_LOG_OPACITY)
    return jnp.concatenate([rows, dummy])


def geometry_gradient(
    moments: Sequence[Array], factor: Sequence[Array], center: Sequence[Array], scale: float
) -> tuple[Array, ...]:
    """Return the gradient to the first six columns of a row, from moments over a tile.

    Args:
        moments: sums over the tile's pixels of the gradient to the exponent, times 1, x, y, x^2,
            x y, y^2, with x and y from the tile's centre.
        factor: a11, a12, a22.
        center: u, v, and the offsets x and y from the mean, at the tile's centre.
        scale: the plan's `exponent_scale`.
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
