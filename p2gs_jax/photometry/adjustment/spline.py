"""The response spline in the adjustment: values under it, and sums over its basis."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.rows import Rows
from p2gs_jax.photometry.response import FLOOR, FREE, KNOTS, SMALLEST_SLOPE

_FREE = np.array(FREE)


def under_spline(
    rows: Rows, c: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "o 3"], Float[np.ndarray, "o 3"], Float[np.ndarray, "o 3"]]:
    """Return z, its standard deviation and dz/dy under a spline over the base curve.

    Args:
        rows: observations.
        c: the spline at its free knots.
    """
    full = np.zeros(len(KNOTS))
    full[_FREE] = c
    z = rows.z + (1 - rows.fraction) * full[rows.knot] + rows.fraction * full[rows.knot + 1]
    steeper = (np.diff(full) / np.diff(KNOTS))[rows.knot]
    slope = np.maximum(rows.slope + steeper, SMALLEST_SLOPE * rows.slope)
    of_pixel = np.maximum(rows.sigma**2 - FLOOR**2, 0) * (slope / rows.slope) ** 2
    return z, np.sqrt(of_pixel + FLOOR**2), slope


def at_knots(
    rows: Rows, values: Float[np.ndarray, "o 3"], index: np.ndarray, size: int
) -> Float[np.ndarray, "size k"]:
    """Return sums of values times the spline's basis, free knots only.

    Args:
        rows: for the knots; of its basis functions two are not zero at a value.
        values: what is summed.
        index: where each value belongs, broadcast to the shape of `values`.
        size: number of those places.
    """
    at = (np.broadcast_to(index, values.shape) * len(KNOTS) + rows.knot).ravel()
    length = size * len(KNOTS)
    right = values * rows.fraction
    sums = np.bincount(at, (values - right).ravel(), length)
    sums += np.bincount(at + 1, right.ravel(), length + 1)[:length]
    return sums.reshape(size, len(KNOTS))[:, _FREE]


def basis_at_values(rows: Rows) -> sp.csr_array:
    """Return the spline's basis at every observed value, free knots only: (3 o, k)."""
    count = rows.knot.size
    knot, fraction = rows.knot.ravel(), rows.fraction.ravel()
    values = np.stack([1 - fraction, fraction], 1).ravel()
    columns = np.stack([knot, knot + 1], 1).ravel()
    shape = (count, len(KNOTS))
    return sp.csr_array((values, columns, 2 * np.arange(count + 1)), shape=shape)[:, _FREE]


def log_slope_terms(
    rows: Rows, share: Float[np.ndarray, "o 3"], slope: Float[np.ndarray, "o 3"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
    """Return gradient and curvature of the sum of log dz/dy over the spline's free knots.

    A density over photographed values carries the slope of the transform. Without it, a curve that
    is flat nearly everywhere and jumps once explains everything: the residuals vanish with it.

    Args:
        rows: for the knots.
        share: how much each value counts.
        slope: dz/dy under the spline.
    """
    steps = np.diff(np.eye(len(KNOTS)), axis=0)[:, _FREE] / np.diff(KNOTS)[:, None]
    first, second = (
        np.bincount(rows.knot.ravel(), (share / slope**k).ravel(), len(KNOTS) - 1) for k in (1, 2)
    )
    return steps.T @ first, steps.T @ (second[:, None] * steps)
