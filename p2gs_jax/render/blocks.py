"""Projection and radiance of the Gaussians that a view may show, block by block.

Their list has a static length and a dynamic count. The time of a loop over blocks follows the
count, and a block fits a core's cache: gathering 48 spherical-harmonics coefficients of 57k
Gaussians at once took as long as projecting them (BUILD_NOTES, "The step costs what a view shows").
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.objects import camera_of_each
from p2gs_jax.render.project import project, view_radiance
from p2gs_jax.render.vibration import at_time
from p2gs_jax.types import Camera, Frustum, Gaussians, Splats2D

BLOCK = 4096

Shown = tuple[Splats2D, Float[Array, "v 3"]]


def whole_blocks(room: int) -> int:
    """Return `room` rounded up to whole blocks."""
    return -(-max(room, 1) // BLOCK) * BLOCK


def take_rows(gaussians: Gaussians, ids: Int[Array, " v"], bands: int) -> Gaussians:
    """Return some Gaussians, with their first spherical-harmonics coefficients only.

    Args:
        gaussians: parameters or moments.
        ids: which; those out of bounds give the last one.
        bands: how many coefficients.
    """

    def rows(a):
        return a.at[ids].get(mode="clip")

    return Gaussians(
        means=rows(gaussians.means),
        quats=rows(gaussians.quats),
        log_scales=rows(gaussians.log_scales),
        opacity_logits=rows(gaussians.opacity_logits),
        sh=gaussians.sh.at[ids, :bands].get(mode="clip"),
        vibration=jax.tree.map(rows, gaussians.vibration),
    )


def put_rows(gaussians: Gaussians, ids: Int[Array, " v"], new: Gaussians) -> Gaussians:
    """Return Gaussians with some rows replaced; the inverse of `take_rows`.

    Args:
        gaussians: parameters or moments.
        ids: where, each once; those out of bounds go nowhere.
        new: from `take_rows`, changed.
    """

    def rows(a, b):
        return a.at[ids].set(b, mode="drop", unique_indices=True)

    bands = new.sh.shape[1]
    return Gaussians(
        means=rows(gaussians.means, new.means),
        quats=rows(gaussians.quats, new.quats),
        log_scales=rows(gaussians.log_scales, new.log_scales),
        opacity_logits=rows(gaussians.opacity_logits, new.opacity_logits),
        sh=gaussians.sh.at[ids, :bands].set(new.sh, mode="drop", unique_indices=True),
        vibration=jax.tree.map(rows, gaussians.vibration, new.vibration),
    )


def block_size(length: int) -> int:
    """Return the number of rows of a block: all rows on devices other than CPUs.

    Called while tracing, so that a program contains one of them only.
    """
    return min(BLOCK, length) if jax.default_backend() == "cpu" else length


def slice_of(tree, block: Int[Array, ""] | int, size: int):
    """Return one block of every array of a tree."""
    return jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, block * size, size), tree)


def splat(
    gaussians: Gaussians,
    alive: Bool[Array, " v"],
    cameras: Sequence[Camera | Frustum],
    cfg: RenderConfig,
    active_degree: Int[Array, ""] | int | None = None,
    owner: Int[Array, " v"] | None = None,
) -> tuple[Shown, ...]:
    """Return the splats and the radiance of Gaussians in each of some views."""

    def seen_by(camera: Camera | Frustum) -> Shown:
        now, of_each = at_time(gaussians, camera.objects), camera_of_each(camera, owner)
        return project(now, alive, of_each, cfg), view_radiance(now, of_each, cfg, active_degree)

    return tuple(map(seen_by, cameras))


def owners_at(owner: Int[Array, " n"] | None, ids: Int[Array, " v"]) -> Int[Array, " v"] | None:
    """Return whose some Gaussians are; those out of bounds are nobody's."""
    return None if owner is None else owner.at[ids].get(mode="fill", fill_value=-1)


def splat_listed(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    ids: Int[Array, " v"],
    count: Int[Array, ""],
    cameras: Sequence[Camera | Frustum],
    cfg: RenderConfig,
    active_degree: Int[Array, ""] | int,
    bands: int,
    owner: Int[Array, " n"] | None = None,
) -> tuple[Shown, ...]:
    """Return the splats and the radiance of the listed Gaussians in each of some views.

    Args:
        gaussians: the scene.
        alive: slots in use.
        ids: from `compact`, whole blocks.
        count: how many are listed.
        cameras: the views.
        cfg: rendering options.
        active_degree: spherical-harmonics degree in use.
        bands: number of coefficients in use.
        owner: see `render_linear`.
    """

    length = ids.shape[0]
    size = block_size(length)

    def block(k):
        here = slice_of(ids, k, size)
        shown = alive.at[here].get(mode="fill", fill_value=False)
        block = take_rows(gaussians, here, bands)
        return splat(block, shown, cameras, cfg, active_degree, owners_at(owner, here))

    def body(k, out):
        return jax.tree.map(
            lambda a, b: lax.dynamic_update_slice_in_dim(a, b, k * size, 0), out, block(k)
        )

    blank = jax.tree.map(
        lambda s: jnp.zeros((length, *s.shape[1:]), s.dtype), jax.eval_shape(block, jnp.int32(0))
    )
    used = jnp.minimum(count, length)
    return lax.fori_loop(0, -(-used // size), body, blank)
