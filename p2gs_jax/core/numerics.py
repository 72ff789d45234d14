"""A logarithm that stays finite over all of float32, sRGB, and small numeric helpers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike, DTypeLike

LN2 = math.log(2.0)

Record = TypeVar("Record")
# Results are on the host or on a device like the arguments.
Values = TypeVar("Values", Array, np.ndarray)
Scalar = Array | np.ndarray | np.floating | float


def namespace(*values) -> Any:
    """Return numpy if all values are on the host, or jax.numpy if any is on a device or traced.

    The same code then works in compiled programs and on the host, where every operation of JAX
    would compile a program for every new shape.
    """
    return jnp if any(isinstance(value, jax.Array) for value in values) else np


def on_device(values: ArrayLike, dtype: DTypeLike = np.float32) -> Array:
    """Return host values on the device; unlike `jnp.asarray`, this compiles nothing."""
    return jax.device_put(np.asarray(values, dtype))


def device_bytes() -> int:
    """Return the memory of the default device, bytes; 0 on the host, or if it is unknown."""
    if jax.default_backend() == "cpu":
        return 0
    return (jax.devices()[0].memory_stats() or {}).get("bytes_limit", 0)


def matmul(a: Array | np.ndarray, b: Array | np.ndarray) -> Any:
    """Return a @ b in full precision: GPUs round float32 to three digits (TF32) by default."""
    if namespace(a, b) is np:
        return a @ b
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def safe_log(x: Values, floor: float) -> Values:
    """Return log(max(x, floor)); the gradient is zero at and below the floor, NaN stays NaN."""
    xp = namespace(x)
    below = x <= floor
    return xp.where(below, math.log(floor), xp.log(xp.where(below, 1.0, x)))


def unit_clip(x: Array) -> Array:
    """Return x clipped to [0, 1]; at the bounds the gradient is 1."""
    return jnp.where(x > 1, 1.0, jnp.where(x < 0, 0.0, x))


def evenly_spaced(count: int, most: int) -> Int[np.ndarray, " k"]:
    """Return at most `most` indices below `count`, evenly spaced, with both ends if most > 1."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def fibonacci_sphere(count: int) -> Float[np.ndarray, "n 3"]:
    """Return `count` evenly spread unit vectors."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    azimuth = np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], -1)


def on_host(record: Callable[..., Record], *values: Any) -> Record:
    """Return a record of host arrays, which compiled programs accept.

    The call only satisfies type checkers, because fields of records are annotated with `Array`.
    """
    return record(*values)


def srgb_encode(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the sRGB encoding (IEC 61966-2-1) of linear values, clipped to [0, 1].

    The precision is that of the argument. Fits use the curve in `photometry.formation`.
    """
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return linear values of sRGB-encoded values in [0, 1]."""
    y = np.asarray(encoded)
    return np.where(y <= 0.04045, y / 12.92, ((np.maximum(y, 0.0) + 0.055) / 1.055) ** 2.4)
