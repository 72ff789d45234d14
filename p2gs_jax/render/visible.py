"""Which Gaussians a view can show, and a compact list of them.

One view of a drive sees a fifth of the population. Everything that is done per Gaussian
(projection, spherical harmonics, their gradients, the optimiser) is done for that list only.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import namespace
from p2gs_jax.render.cutoff import smallest_cutoff
from p2gs_jax.render.project import LOG_SCALE_RANGE, TANGENT_LIMIT
from p2gs_jax.render.vibration import at_time
from p2gs_jax.render.xla_cpu import compiled_loop
from p2gs_jax.types import Camera, Frustum, Gaussians

# Pixels of slack for rounding.
SLACK = 1.0


def in_view(
    gaussians: Gaussians, alive: Bool[Array, " n"], camera: Camera | Frustum, cfg: RenderConfig
) -> Bool[Array, " n"]:
    """Return which Gaussians may reach a pixel: a conservative bound.

    The projected covariance is bounded by that of a ball as wide as the widest axis: along x its
    deviation is at most s f / z sqrt(1 + t^2), t being the tangent at which `project` evaluates.

    Args:
        gaussians: the scene; NumPy arrays give a NumPy result.
        alive: slots in use.
        camera: the view.
        cfg: near plane, blur and cutoffs.
    """
    gaussians = at_time(gaussians, camera.objects)
    xp = namespace(gaussians.means, camera.viewmat)
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    x, y, z = (sum(gaussians.means[:, k] * R[i, k] for k in range(3)) + t[i] for i in range(3))
    reach = -xp.logaddexp(0.0, -gaussians.opacity_logits) - float(np.log(smallest_cutoff(cfg)))
    seen = alive & (z > cfg.near) & (reach > 0)
    inverse_z = 1 / xp.where(z > cfg.near, z, 1.0)
    widest = xp.exp(xp.clip(xp.max(gaussians.log_scales, -1), *LOG_SCALE_RANGE))
    sizes = ((x, camera.width, 0), (y, camera.height, 1))
    for along, size, axis in sizes:
        f, c = camera.K[axis, axis], camera.K[axis, 2]
        tangent = along * inverse_z
        limit = TANGENT_LIMIT * size / (2 * f)
        slant = xp.clip(tangent, -limit, limit)
        deviation2 = (widest * f * inverse_z) ** 2 * (1 + slant * slant) + cfg.blur
        radius = xp.sqrt(2 * xp.maximum(reach, 0) * deviation2) + SLACK
        # Comparisons with NaN are false: what is not finite counts as seen, and `project` hides it.
        at = f * tangent + c
        seen = seen & ~((at + radius < 0) | (at - radius > size))
    return seen


@compiled_loop
def _list(seen, blank):
    def body(i, state):
        count, ids = state
        at = jnp.minimum(count, ids.shape[0] - 1)
        ids = lax.dynamic_update_slice(ids, i[None].astype(jnp.int32), (at,))
        return count + lax.dynamic_slice(seen, (i,), (1,))[0].astype(jnp.int32), ids

    return lax.fori_loop(0, seen.shape[0], body, (jnp.int32(0), blank))


def _list_in_parallel(seen, blank):
    place = jnp.cumsum(seen, dtype=jnp.int32) - 1
    index = jnp.arange(seen.shape[0], dtype=jnp.int32)
    where = jnp.where(seen, place, blank.shape[0])
    return place[-1] + 1, blank.at[where].set(index, mode="drop")


def compact(seen: Bool[Array, " n"], room: int) -> tuple[Int[Array, " v"], Int[Array, ""]]:
    """Return the indices of set flags, in order.

    Args:
        seen: flags.
        room: length of the list.

    Returns:
        Indices, padded with n; and their number, which may exceed `room`.
    """
    n = seen.shape[0]
    # One more place than `room` receives what does not fit.
    blank = jnp.full(room + 1, n, jnp.int32)
    count, ids = lax.platform_dependent(seen, blank, cpu=_list, default=_list_in_parallel)
    used = jnp.arange(room, dtype=jnp.int32) < count
    return jnp.where(used, ids[:room], n), count
