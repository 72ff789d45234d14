"""One view divided over the cores of a CPU, each a device of JAX (docs/scaling.md).

A program that `jax.shard_map` divides along the axis `CORES` is traced once for all N cores. In
such a program, each core composites every N-th row of tiles and computes SSIM on a strip of the
image; then all cores get the whole result. In other programs there is one core, and all
functions except `part` and `scatter_sum` add no operation.
"""

from __future__ import annotations

import functools
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

CORES = "cores"
Tree = TypeVar("Tree")


def cores() -> int:
    """Return the number of cores over which the traced program is divided."""
    return jax.sharding.get_abstract_mesh().shape.get(CORES, 1)


def this_core() -> Int[Array, ""] | int:
    """Return the index of the core, from 0."""
    return lax.axis_index(CORES) if cores() > 1 else 0


def gather(tree: Tree, axis: int = 0) -> Tree:
    """Return the arrays of all cores, concatenated along an axis."""
    if cores() == 1:
        return tree
    return jax.tree.map(lambda a: lax.all_gather(a, CORES, axis=axis, tiled=True), tree)


def scatter_sum(tree: Tree) -> Tree:
    """Return the core's part of the sum over all cores (2 or more), along the first axis."""
    return jax.tree.map(lambda a: lax.psum_scatter(a, CORES, tiled=True), tree)


def part(a: Array) -> Array:
    """Return the core's part, along the first axis, of an array that is equal on all cores."""
    size = a.shape[0] // cores()
    return lax.dynamic_slice_in_dim(a, this_core() * size, size)


def total(a: Array) -> Array:
    """Return the sum over all cores."""
    return lax.psum(a, CORES) if cores() > 1 else a


def most(count: Int[Array, ""]) -> Int[Array, ""]:
    """Return the largest count of any core, times the number of cores."""
    return lax.pmax(count, CORES) * cores() if cores() > 1 else count


def all_true(flags: Bool[Array, "..."]) -> Bool[Array, "..."]:
    """Return flags that are true where the flags of every core are true."""
    return lax.pmin(flags.astype(jnp.int32), CORES) > 0 if cores() > 1 else flags


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def gather_rows(tiles: Float[Array, "t p"], across: int) -> Float[Array, "a p"]:
    """Return the tiles of all cores in the order of the image; core k has its rows k, k + N, ...

    `across` is the number of tiles of a row. All cores do the same work after this. Each therefore
    knows the whole gradient, and its backward pass selects its rows.
    """
    if cores() == 1:
        return tiles
    each = lax.all_gather(tiles.reshape(-1, across, tiles.shape[-1]), CORES, axis=1)
    return each.reshape(-1, tiles.shape[-1])


def _gather_rows_fwd(tiles, across: int):
    return gather_rows(tiles, across), None


def _gather_rows_bwd(across: int, _, v_tiles):
    rows = v_tiles.reshape(-1, cores(), across, v_tiles.shape[-1])
    of_core = lax.dynamic_index_in_dim(rows, this_core(), 1, keepdims=False)
    return (of_core.reshape(-1, v_tiles.shape[-1]),)


gather_rows.defvjp(_gather_rows_fwd, _gather_rows_bwd)
