"""Real spherical harmonics to degree 3, in the sign convention of 3DGS, and linear HDR radiance."""

from __future__ import annotations

from typing import Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int

from p2gs_jax.core.numerics import Values, namespace
from p2gs_jax.render.xla_cpu import stack_columns

RadianceKind = Literal["exp", "linear"]
LOG_RADIANCE_LIMIT = 30.0  # natural logarithm

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
MAX_DEGREE = 3

Axis = Float[Array | np.ndarray, " n"]
Directions = tuple[Axis, Axis, Axis]


def coefficient_count(degree: int) -> int:
    """Return (degree + 1)^2, the number of coefficients up to a degree."""
    return (degree + 1) ** 2


def degree_of(count: int) -> int:
    """Return the degree that has `count` coefficients; ValueError: `count` is not 1, 4, 9 or 16."""
    degree = {coefficient_count(d): d for d in range(MAX_DEGREE + 1)}.get(count)
    if degree is None:
        raise ValueError(f"{count} is not a valid number of spherical-harmonics coefficients")
    return degree


def basis(directions: Directions, degree: int) -> list[Axis]:
    """Return the (degree + 1)^2 basis values of unit directions, as separate vectors."""
    x, y, z = directions
    xx, yy, zz = x * x, y * y, z * z
    values: list = [jnp.full_like(x, C0)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        values += [
            C2[0] * x * y,
            -C2[0] * y * z,
            C2[1] * (2.0 * zz - xx - yy),
            -C2[0] * x * z,
            C2[2] * (xx - yy),
        ]
    if degree >= 3:
        values += [
            -C3[0] * y * (3.0 * xx - yy),
            C3[1] * x * y * z,
            -C3[2] * y * (4.0 * zz - xx - yy),
            C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -C3[2] * x * (4.0 * zz - xx - yy),
            C3[4] * z * (xx - yy),
            -C3[0] * x * (xx - 3.0 * yy),
        ]
    return values


_compiled_basis = jax.jit(basis, static_argnums=1)


def table(directions: Float[np.ndarray, "d 3"], degree: int) -> Float32[np.ndarray, "d k"]:
    """Return the basis values of unit directions, on the host."""
    return np.stack(_compiled_basis(tuple(directions.astype(np.float32).T), degree), 1)


@jax.custom_vjp
def _combine(values: Float[Array, "n k"], sh: Float[Array, "n k 3"]) -> Float[Array, "n 3"]:
    """Return sum_k values[:, k] sh[:, k], with a gradient that is one outer product.

    The plain gradient pads and adds K slices (29 against 9 ms for 100k Gaussians of degree 3).
    """
    return sum((values[:, k, None] * sh[:, k] for k in range(sh.shape[1])), jnp.zeros(()))


def _combine_fwd(values, sh):
    return _combine(values, sh), (values, sh)


def _combine_bwd(residuals, v):
    values, sh = residuals
    v_values = sum(sh[:, :, c] * v[:, None, c] for c in range(3))
    return v_values, values[:, :, None] * v[:, None, :]


_combine.defvjp(_combine_fwd, _combine_bwd)


def evaluate(
    sh: Float[Array | np.ndarray, "n k 3"],
    directions: Directions,
    active_degree: Int[Array, ""] | int | None = None,
) -> Float[Array, "n 3"]:
    """Return the sums of K = (degree + 1)^2 harmonics in unit directions, before activation.

    Directions are x, y and z from the camera to the Gaussians, along world axes. Coefficients above
    `active_degree` are ignored; a traced `active_degree` may change without a compilation.
    """
    degree = degree_of(sh.shape[1])
    columns = basis(directions, degree)
    if active_degree is not None:
        degrees = [d for d in range(degree + 1) for _ in range(2 * d + 1)]
        columns = [
            c if d == 0 else jnp.where(active_degree >= d, c, 0.0)
            for d, c in zip(degrees, columns, strict=True)
        ]
    return _combine(stack_columns(cast(list[Array], columns)), sh)


def radiance_activation(value: Values, kind: RadianceKind) -> Values:
    """Return radiance >= 0 from sums of spherical harmonics.

    `exp` treats a sum as log radiance, clipped to +-30; `linear` is max(0, value + 1/2), as in 3DGS
    and the paper.
    """
    xp = namespace(value)
    if kind == "exp":
        return xp.exp(xp.clip(value, -LOG_RADIANCE_LIMIT, LOG_RADIANCE_LIMIT))
    return xp.maximum(value + 0.5, 0.0)


def radiance_preactivation(radiance: Values, kind: RadianceKind) -> Values:
    """Return the value whose activation is `radiance` > 0."""
    if kind == "exp":
        return namespace(radiance).log(radiance)
    return radiance - 0.5


def scaled(
    sh: Float[np.ndarray, "n k 3"], log_factors: Float[np.ndarray, " 3"], kind: RadianceKind
) -> Float[np.ndarray, "n k 3"]:
    """Return coefficients whose radiance is multiplied by exp(`log_factors`), exactly."""
    sh = np.array(sh)
    if kind == "exp":
        sh[:, 0] += log_factors / C0
    else:
        # radiance = value + 1/2, so the constant 1/2 must be scaled, too.
        factors = np.exp(log_factors)
        sh *= factors
        sh[:, 0] += (factors - 1) * 0.5 / C0
    return sh
