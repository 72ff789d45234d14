"""The fitted response as a curve of image formation: its encoding, and the inverse.

A response gives log exposed radiance of display values (photometry/response.py); image formation
needs the way back, which is tabulated over equal steps of log x. Where every camera, or every
channel of a camera, has a response of its own, there is a table for each.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.numerics import Values, namespace
from p2gs_jax.photometry.cameras import UNKNOWN
from p2gs_jax.photometry.response import DARKEST, KNOTS, Response, log_exposed

TABLE = 1024


class Tables(NamedTuple):
    """Display values over equal steps of log x.

    Attributes:
        first: log x of the first entry, of every row.
        step: between entries.
        values: display values.
        channels: rows of one camera: 1 for all channels, or 3.
    """

    first: Float[np.ndarray, " r"]
    step: Float[np.ndarray, " r"]
    values: Float[np.ndarray, "r n"]
    channels: int


@functools.lru_cache(64)
def _table(spline: tuple[float, ...]) -> tuple[float, float, np.ndarray]:
    y = np.linspace(DARKEST, 1.0, 4096)
    z = np.maximum.accumulate(log_exposed(y, Response("srgb", spline))[0])
    z = z + 1e-9 * np.arange(len(z))
    grid = np.linspace(z[0], z[-1], TABLE)
    return float(grid[0]), float(grid[1] - grid[0]), np.interp(grid, z, y)


def by_camera(cfg: PhotometryConfig) -> bool:
    """Return whether any camera has a response of its own."""
    return any(camera.splines for camera in cfg.cameras)


@functools.lru_cache(8)
def tables(cfg: PhotometryConfig) -> Tables:
    """Return the tables of all responses.

    With responses per camera there are rows for each, in order, and at the end for an unknown one:
    the spline of all cameras, or else the mean of those there are.

    Raises:
        ValueError: there is no spline.
    """
    if cfg.spline is None and not by_camera(cfg):
        raise ValueError("the curve 'spline' needs the values of its spline")
    cameras = range(len(cfg.cameras)) if by_camera(cfg) else ()
    each = [spline_of(cfg, camera) for camera in (*cameras, UNKNOWN)]
    channels = max(map(len, each))
    splines = [row for rows in each for row in _rows(rows, channels)]
    first, step, values = zip(*map(_table, splines), strict=True)
    return Tables(np.array(first), np.array(step), np.array(values), channels)


def _rows(splines: tuple[tuple[float, ...], ...], channels: int) -> tuple[tuple[float, ...], ...]:
    return splines * channels if len(splines) == 1 else splines


def spline_of(cfg: PhotometryConfig, camera: int | None = None) -> tuple[tuple[float, ...], ...]:
    """Return the spline of a camera, on the host: one row for all channels, or one for each.

    Args:
        cfg: the formation model; without any spline the values are 0, which is sRGB.
        camera: row in `cfg.cameras`; None or -1: one that is not there.
    """
    own = () if camera is None or camera < 0 else cfg.cameras[camera].splines
    if own:
        return own
    if cfg.spline is not None:
        return (cfg.spline,)
    others = [c.splines for c in cfg.cameras if c.splines]
    if not others:
        return ((0.0,) * len(KNOTS),)
    channels = max(map(len, others))
    mean = np.mean([_rows(s, channels) for s in others], 0)
    return tuple(tuple(map(float, row)) for row in mean)


def encode(log_linear: Values, cfg: PhotometryConfig, camera=None) -> Values:
    """Return display values through the table; linear in x below it, in log x above it.

    Args:
        log_linear: log exposed radiance; with responses per channel its last axis is the channel.
        cfg: the splines.
        camera: row in `cfg.cameras`; None: unknown. One for all, or one for every entry but for
            the last axis.
    """
    xp, table = namespace(log_linear, camera), tables(cfg)
    if by_camera(cfg):
        row = _row(table, camera, xp)
        first, step = (xp.asarray(v, log_linear.dtype)[row] for v in (table.first, table.step))
        flat, start = table.values.reshape(-1), row * TABLE
        dimmest = xp.asarray(table.values[:, 0], log_linear.dtype)[row]
    else:
        first, step, flat = float(table.first[0]), float(table.step[0]), table.values[0]
        start, dimmest = None, float(flat[0])
    place = (log_linear - first) / step
    left = xp.clip(xp.floor(place), 0, TABLE - 2).astype(np.int32)
    values = xp.asarray(flat, log_linear.dtype)
    at = left if start is None else left + start
    # Above the table the last segment goes on, so that over-bright predictions keep a gradient.
    inside = values[at] + (place - left) * (values[at + 1] - values[at])
    dark = place < 0
    below = dimmest * xp.exp(xp.where(dark, log_linear - first, 0.0))
    return xp.where(dark, below, inside)


def decode(y: Values, cfg: PhotometryConfig, camera=None) -> Values:
    """Return log exposed radiance of display values; those beyond the table count as its ends.

    Args:
        y: display values.
        cfg: the splines.
        camera: as for `encode`.
    """
    xp, table = namespace(y, camera), tables(cfg)
    if not by_camera(cfg):
        logs = table.first[0] + table.step[0] * np.arange(TABLE)
        # numpy's interp computes and returns double precision.
        return xp.interp(y, table.values[0].astype(y.dtype), logs.astype(y.dtype)).astype(y.dtype)
    row = _row(table, camera, xp)
    values = xp.asarray(table.values.reshape(-1), y.dtype)
    # `interp` takes one table; this halves intervals until one entry is left.
    left, span = xp.zeros(y.shape, np.int32), TABLE
    while span > 1:
        span //= 2
        left = xp.where(values[left + span + row * TABLE] <= y, left + span, left)
    left = xp.minimum(left, TABLE - 2)
    low, high = values[left + row * TABLE], values[left + 1 + row * TABLE]
    along = xp.clip((y - low) / xp.maximum(high - low, 1e-9), 0, 1)
    first, step = (xp.asarray(v, y.dtype)[row] for v in (table.first, table.step))
    return first + step * (left + along)


def _row(table: Tables, camera, xp) -> Int[Array, "..."]:
    """Return the row of every entry's table, shaped to broadcast against display values."""
    count = len(table.first) // table.channels
    given = xp.asarray(-1 if camera is None else camera)
    given = xp.where(given < 0, count - 1, given)[..., None]
    return (given * table.channels + np.arange(table.channels)).astype(np.int32)
