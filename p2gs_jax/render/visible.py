"""The Gaussians that a view may show: a compact list, and their splats, block by block.

One view of a drive shows about 20 % of the population. Work per Gaussian (projection, spherical
harmonics, their gradients, the optimiser) is done only for the list. The list has a static length
and a dynamic count, and the time of a loop over its blocks depends on the count. A block fits a
core's cache (BUILD_NOTES, "The step costs what a view shows").
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import namespace
from p2gs_jax.render.project import (
    LOG_SCALE_RANGE,
    TANGENT_LIMIT,
    at_time,
    camera_of_each,
    project,
    view_radiance,
)
from p2gs_jax.render.xla_cpu import compiled_loop
from p2gs_jax.types import Array, Camera, Frustum, Gaussians, Splats2D

SLACK = 1.0  # margin for rounding, pixels
BLOCK = 4096  # Gaussians

Shown = tuple[Splats2D, Float[Array, "v 3"]]


def in_view(
    gaussians: Gaussians,
    alive: Bool[Array | np.ndarray, " n"],
    camera: Camera | Frustum,
    cfg: RenderConfig,
) -> Bool[Any, " n"]:
    """Return flags of the Gaussians that may reach a pixel: a conservative bound.

    The projection of a ball with the largest scale s bounds the projected covariance. Along x its
    standard deviation is at most s f / z sqrt(1 + t^2), with t the tangent that `project` uses.
    NumPy arrays give a NumPy result.
    """
    gaussians = at_time(gaussians, camera.objects)
    xp = namespace(gaussians.means, camera.viewmat)
    R, t = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    x, y, z = (sum(gaussians.means[:, k] * R[i, k] for k in range(3)) + t[i] for i in range(3))
    reach = -xp.logaddexp(0.0, -gaussians.opacity_logits) - float(np.log(cfg.alpha_cutoff))
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
        # Comparisons with NaN are false: Gaussians that are not finite pass, and `project` hides
        # them.
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


def compact(seen: Bool[Array, " n"], length: int) -> tuple[Int[Array, " v"], Int[Array, ""]]:
    """Return the indices of set flags in order, padded with n to `length`; and their number.

    The number may exceed `length`; then the list holds the first indices.
    """
    n = seen.shape[0]
    # The last of `length + 1` places receives the indices that do not fit.
    blank = jnp.full(length + 1, n, jnp.int32)
    list_flags = _list if jax.default_backend() == "cpu" else _list_in_parallel
    count, ids = list_flags(seen, blank)
    used = jnp.arange(length, dtype=jnp.int32) < count
    return jnp.where(used, ids[:length], n), count


def whole_blocks(length: int) -> int:
    """Return `length`, at least 1, rounded up to whole blocks."""
    return -(-max(length, 1) // BLOCK) * BLOCK


def take_rows(gaussians: Gaussians, ids: Int[Array, " v"], bands: int) -> Gaussians:
    """Return the Gaussians (or moments) of these ids, with the first `bands` coefficients only.

    Ids out of bounds give the last Gaussian.
    """

    def rows(a):
        return a.at[ids].get(mode="clip")

    rest = jax.tree.map(rows, eqx.tree_at(lambda g: g.sh, gaussians, None))
    return dataclasses.replace(rest, sh=gaussians.sh.at[ids, :bands].get(mode="clip"))


def put_rows(gaussians: Gaussians, ids: Int[Array, " v"], new: Gaussians) -> Gaussians:
    """Return Gaussians with the rows `ids` replaced by `new`, of the shape of `take_rows`.

    Every id occurs once; rows of ids out of bounds are dropped.
    """

    def rows(a, b):
        return a.at[ids].set(b, mode="drop", unique_indices=True)

    rest = jax.tree.map(rows, *(eqx.tree_at(lambda g: g.sh, g, None) for g in (gaussians, new)))
    sh = gaussians.sh.at[ids, : new.sh.shape[1]].set(new.sh, mode="drop", unique_indices=True)
    return dataclasses.replace(rest, sh=sh)


def block_size(length: int) -> int:
    """Return the number of rows of a block: all rows on devices other than CPUs.

    It is called while JAX traces, so that a program contains only one variant.
    """
    return min(BLOCK, length) if jax.default_backend() == "cpu" else length


def slice_of(tree, block: Int[Array, ""] | int, size: int):
    """Return one block of every array of a tree."""
    return jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, block * size, size), tree)


def over_blocks(body: Callable, count: Int[Array, ""], length: int, start):
    """Return the state after `body(block, state)` for every used block of a list.

    The list has `length` rows, of which the first `count` are used; after an overflow `count` is
    larger. A single block needs no loop, whose dynamic count the host of a GPU would have to read.
    """
    size = block_size(length)
    if size == length:
        return body(jnp.int32(0), start)
    return lax.fori_loop(0, -(-jnp.minimum(count, length) // size), body, start)


def splat(
    gaussians: Gaussians,
    alive: Bool[Array, " v"],
    camera: Camera | Frustum,
    cfg: RenderConfig,
    active_degree: Int[Array, ""] | int | None = None,
    owner: Int[Array, " v"] | None = None,
) -> Shown:
    """Return the splats and the radiance of Gaussians in a view."""
    now, of_each = at_time(gaussians, camera.objects), camera_of_each(camera, owner)
    return project(now, alive, of_each, cfg), view_radiance(now, of_each, cfg, active_degree)


def owners_at(owner: Int[Array, " n"] | None, ids: Int[Array, " v"]) -> Int[Array, " v"] | None:
    """Return the moving object of each id; -1 (none) for ids out of bounds."""
    return None if owner is None else owner.at[ids].get(mode="fill", fill_value=-1)


def splat_listed(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    ids: Int[Array, " v"],
    count: Int[Array, ""],
    camera: Camera | Frustum,
    cfg: RenderConfig,
    active_degree: Int[Array, ""] | int,
    bands: int,
    owner: Int[Array, " n"] | None = None,
) -> Shown:
    """Return the splats and the radiance of the listed Gaussians in a view.

    `ids` is from `compact`, in whole blocks; its first `count` ids are used. `bands` is the number
    of spherical-harmonics coefficients in use.
    """
    length = ids.shape[0]
    size = block_size(length)

    def block(k):
        here = slice_of(ids, k, size)
        live = alive.at[here].get(mode="fill", fill_value=False)
        block = take_rows(gaussians, here, bands)
        return splat(block, live, camera, cfg, active_degree, owners_at(owner, here))

    def body(k, out):
        return jax.tree.map(
            lambda a, b: lax.dynamic_update_slice_in_dim(a, b, k * size, 0), out, block(k)
        )

    blank = jax.tree.map(
        lambda s: jnp.zeros((length, *s.shape[1:]), s.dtype), jax.eval_shape(block, jnp.int32(0))
    )
    return over_blocks(body, count, length, blank)
