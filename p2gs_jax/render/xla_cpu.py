"""Idioms that XLA's CPU backend compiles well, each measured (BUILD_NOTES, "The kernel").

They do not change results. On other backends `materialize` adds no conditional, which would stop
the device until the host has read a flag. `compiled_loop` is a loop on every backend.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Bool, Float

# 512-bit vectors, if the CPU has them, are 1.1 to 1.25 times as fast as XLA's default of 256 bits
# (BUILD_NOTES). LLVM's optimisation level 1 compiles a step 15 % faster, and the step is as fast.
_CPU_OPTIONS = {"xla_cpu_prefer_vector_width": 512, "xla_backend_optimization_level": 1}

F = TypeVar("F", bound=Callable)

SMALL_CALL = "xla_cpu_small_call"


def compiled_loop(f: F) -> F:
    """Return `f` compiled as one sequential native function if XLA runs on a CPU.

    A `lax.while_loop` on the CPU normally launches kernels in every iteration, about 300 ns each.
    XLA compiles small loops as a whole; the attribute set here requests this for any size. A
    counting sort then takes 6 ns per entry, and `lax.sort` takes 54 ns.

    `sequential_vmap` turns vmap into a loop over calls, because batched scatters cannot be compiled
    like this. It also keeps the call whole where the code around it is differentiated: constants in
    a call without arguments would become invalid code there (jaxlib 0.10).

    `f` is a pure function of arrays, without matrix products, sorts or convolutions. The result
    cannot be differentiated.
    """

    @jax.custom_batching.sequential_vmap
    def call(*args):
        # `inlineable` keeps XLA from inlining the call before the backend sees its attribute.
        with set_xla_metadata(**{SMALL_CALL: "true", "inlineable": "false"}):
            return jax.jit(f)(*lax.optimization_barrier(args))

    return call  # pyright: ignore[reportReturnType]


def compiler_options() -> dict[str, int] | None:
    """Return the `compiler_options` of an outermost `jax.jit` around a renderer; None: defaults."""
    return _CPU_OPTIONS if jax.default_backend() == "cpu" else None


def opaque_true(sample: Float[Array, ""]) -> Bool[Array, ""]:
    """Return true, computed from data so that XLA cannot fold it; NaN gives true, too."""
    return (sample == sample) | (sample != 0)


def materialize(always: Bool[Array, ""], compute):
    """Return the arrays of `compute()`, stored in memory before they are used.

    XLA's CPU backend fuses through `optimization_barrier` and then recomputes the whole chain in
    each consumer; a conditional prevents this. `always` is true, but computed from data, so that
    XLA cannot fold it: `opaque_true`.
    """
    if jax.default_backend() != "cpu":
        return compute()
    shapes = jax.eval_shape(compute)
    return lax.cond(
        always, compute, lambda: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    )


@jax.custom_vjp
def columns(a: Float[Array, "n k"]) -> tuple[Float[Array, " n"], ...]:
    """Return the columns of a matrix, with a gradient that computes each column once.

    The plain gradient of slicing is a sum of padded columns, which XLA evaluates element by
    element. It repeats the whole computation of a column once per column (18 instead of 6 ms for
    the projection of 100,000 Gaussians).
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
