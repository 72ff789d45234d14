"""Idioms that XLA's CPU backend compiles well, each measured (BUILD_NOTES, "The kernel").

None of them changes a result. On other backends they leave nothing in a program: there, a
conditional or a loop with a dynamic count stops the device until the host has read a flag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Bool, Float

# 512-bit vectors where the CPU has them; XLA prefers 256 (5-20 % of a render, BUILD_NOTES). LLVM's
# first level of optimisation compiles a step 15 % sooner, and the step is no slower.
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": 512, "xla_backend_optimization_level": 1}

F = TypeVar("F", bound=Callable)

SMALL_CALL = "xla_cpu_small_call"


def compiled_loop(f: F) -> F:
    """Return `f` compiled as one sequential native function where XLA runs on a CPU.

    A `lax.while_loop` on the CPU normally launches kernels in every iteration, about 300 ns each.
    XLA compiles loops whole that it considers small; the attribute set here asks for that whatever
    the size: a counting sort then takes 6 ns an entry where `lax.sort` takes 54.

    `sequential_vmap` makes vmap a loop over calls, since batched scatters cannot be compiled so,
    and keeps the call whole under differentiation: its constants in a call without arguments would
    become invalid code (XLA 0.10).

    `f` is a pure function of arrays, without matrix products, sorts or convolutions; it cannot be
    differentiated.
    """

    @jax.custom_batching.sequential_vmap
    def call(*args):
        # `inlineable` keeps XLA from dissolving the call before the backend sees its attribute.
        with set_xla_metadata(**{SMALL_CALL: "true", "inlineable": "false"}):
            return jax.jit(f)(*lax.optimization_barrier(args))

    return call  # pyright: ignore[reportReturnType]


def compiler_options() -> dict[str, int] | None:
    """Return what an outermost `jax.jit` around a renderer should pass as `compiler_options`."""
    return _CPU_OPTIONS if jax.default_backend() == "cpu" else None


def opaque_true(sample: Float[Array, ""]) -> Bool[Array, ""]:
    """Return true, computed from data so that XLA cannot fold it; also for NaN."""
    return (sample == sample) | (sample != 0)


def materialize(always: Bool[Array, ""], compute):
    """Force the arrays that `compute()`, without arguments, returns into memory.

    XLA's CPU backend fuses through `optimization_barrier` and then recomputes the whole chain in
    each consumer (1155 against 421 CPU ms); a conditional survives. `always` is
    true, but computed from data, so that XLA cannot know: `opaque_true`.
    """
    if jax.default_backend() != "cpu":
        return compute()
    shapes = jax.eval_shape(compute)
    return lax.cond(
        always, compute, lambda: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    )


@jax.custom_vjp
def columns(a: Float[Array, "n k"]) -> tuple[Float[Array, " n"], ...]:
    """Return the columns of a matrix, with a gradient that computes each of them once.

    The plain gradient of slicing is a sum of padded columns, which XLA evaluates element by
    element: the whole chain behind every column, once per column (18 against 6 ms for the
    projection of 100k Gaussians).
    """
    return tuple(a[:, i] for i in range(a.shape[1]))


def stack_columns(vectors: Sequence[Float[Array, " n"]]) -> Float[Array, "n k"]:
    """Return vectors as the columns of a matrix, each computed once (see `columns`)."""
    return jnp.stack(materialize(opaque_true(vectors[-1][0]), lambda: list(vectors)), 1)


def _columns_fwd(a):
    return columns(a), a[:1, :1].sum()


def _columns_bwd(sample, v_columns):
    return (jnp.stack(materialize(opaque_true(sample), lambda: v_columns), 1),)


columns.defvjp(_columns_fwd, _columns_bwd)
