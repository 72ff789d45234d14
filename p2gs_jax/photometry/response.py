"""Response curves of cameras: from display values to log exposed radiance, z = F(y), and back.

F is the logarithm of a base curve's decoding, optionally changed by a spline: F(y) = log base^-1(y)
+ B(y) c, with hat functions B over fixed knots. Cameras or channels may have different splines. F
is exact and computed on the host in float64. Image formation needs its inverse on host and device:
a table over equal steps of log x, one for each camera or channel with its spline.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import PhotometryConfig, ResponseKind
from p2gs_jax.core.numerics import Values, namespace
from p2gs_jax.types import Array

Base = Literal["srgb", "power"]
BASES: tuple[Base, ...] = get_args(Base)
# Knots, display values. A single spline is 0 at both knots HELD, which fixes scale and power. Each
# of several splines has a scale of its own, which photographs do not determine: it is 0 at MIDDLE,
# mid-grey. The mean of their changes between the knots HELD is 0.
_PERCENT = [2, 5, 8, 12, 16, 21, 26, 32, 38, 44, 50, 56, 62, 68, 74, 80, 86, 90, 94, 98]
KNOTS = np.array(_PERCENT) / 100
HELD, MIDDLE = (6, 16), 9
# Free knots of a single spline, and of each of several.
FREE = tuple(k for k in range(len(KNOTS)) if k not in HELD)
FREE_OF_EACH = tuple(k for k in range(len(KNOTS)) if k != MIDDLE)
DARKEST = 0.5 / 255  # darkest display value that is decoded: half an 8-bit code
# Noise model: 8-bit quantisation; photon (per light) and read noise, variances of linear values;
# and a floor, deviation in log units, for texture, gloss and interpolation.
SHOT_NOISE, READ_NOISE, FLOOR = 2e-4, 1e-6, 0.03
# Least slope of a curve with a spline, relative to its base, so that noise stays finite.
SMALLEST_SLOPE = 0.2
SMALLEST_LOG_SLOPE = 0.3  # d log exposure / d log value of mid tones; flatter curves have collapsed
TABLE = 1024  # entries of a table
# The row of a camera that is not in `PhotometryConfig.cameras`; tables end with a row for it.
UNKNOWN = -1

Spline = tuple[float, ...]
Numbers = Float[np.ndarray, "..."]


@dataclass(frozen=True)
class Response:
    """A response: one for all photographs, or one for each camera or channel."""

    base: Base = "srgb"  # curve that splines are added to
    # Log exposure added at `KNOTS`; with several splines, their mean. None: there is no spline.
    spline: Spline | None = None
    by: ResponseKind = "all"  # one spline for all, or one for each camera or channel
    # Splines of the cameras, or of red, green and blue; empty where there is one for all.
    splines: tuple[Spline, ...] = ()

    @property
    def name(self) -> str:
        """Name in reports."""
        base, each = self.base.replace("srgb", "sRGB"), f" per {self.by}".replace(" per all", "")
        return base if self.spline is None else f"spline{each} over {base}"

    @property
    def curve(self) -> Literal["srgb", "power", "spline"]:
        """The name of the curve in `PhotometryConfig` and `photometry.json`."""
        return self.base if self.spline is None else "spline"

    @property
    def parts(self) -> tuple[Response, ...]:
        """The single curves: one for all, or one for each camera or channel."""
        return tuple(Response(self.base, spline) for spline in self.splines or (self.spline,))


def spline_count(by: ResponseKind | None, cameras: int) -> int:
    """Return the number of splines: one for `all`, one for each camera or channel; None: 0."""
    return {None: 0, "all": 1, "camera": cameras, "channel": 3}[by]


def spline_parameters(by: ResponseKind | None, cameras: int) -> int:
    """Return the number of free parameters of all splines; arguments as for `spline_count`."""
    # Each spline has a power and a shape; one power is a gauge.
    return spline_count(by, cameras) * len(FREE_OF_EACH) - (by is not None)


def spline_groups(
    by: ResponseKind, cameras: Int[np.ndarray, " o"], shape: tuple[int, ...]
) -> Int[np.ndarray, "o 3"]:
    """Return the row of the spline that decodes each value; `cameras` is of each observation."""
    if by == "camera":
        return np.broadcast_to(cameras[:, None], shape)
    return np.broadcast_to(np.arange(3) if by == "channel" else 0, shape)


def hat(y: Numbers) -> tuple[Int[np.ndarray, "..."], Numbers]:
    """Return the left knot of each value and the fraction of the way to the next one."""
    left = np.clip(np.searchsorted(KNOTS, y) - 1, 0, len(KNOTS) - 2)
    return left, np.clip((y - KNOTS[left]) / (KNOTS[left + 1] - KNOTS[left]), 0, 1)


def base_log(y: Numbers, base: Base) -> tuple[Numbers, Numbers]:
    """Return the log of the decoded value, and its derivative with respect to the display value."""
    y = np.clip(y, DARKEST, 1.0)
    if base == "power":
        return 2.2 * np.log(y), 2.2 / y
    toe = y <= 0.04045
    high = (y + 0.055) / 1.055
    logs = np.where(toe, np.log(y / 12.92), 2.4 * np.log(high))
    return logs, np.where(toe, 1 / y, 2.4 / (y + 0.055))


def log_exposed(
    y: Numbers, response: Response, cameras: Int[np.ndarray, " o"] | None = None
) -> tuple[Numbers, Numbers]:
    """Return z = F(y) and dz/dy; y is (o, 3) if there are several splines."""
    z, slope = base_log(y, response.base)
    if response.spline is None:
        return z, slope
    table = np.asarray(response.splines or (response.spline,), np.float64)
    group: Int[np.ndarray, "..."] | int = 0
    if response.splines:
        of_camera = np.zeros(len(y), int) if cameras is None else cameras
        group = spline_groups(response.by, of_camera, np.shape(y))
    left, t = hat(y)
    low, high = table[group, left], table[group, left + 1]
    steeper = (high - low) / (KNOTS[left + 1] - KNOTS[left])
    return z + (1 - t) * low + t * high, np.maximum(slope + steeper, SMALLEST_SLOPE * slope)


def deviation(
    y: Numbers, slope: Numbers, spread: Numbers | float = 0.0, base: Base = "srgb"
) -> Numbers:
    """Return the standard deviation of z.

    `slope` is dz/dy, `spread` the standard deviation of display values from misplacement and blur;
    photon noise follows the base curve.
    """
    logs, base_slope = base_log(y, base)
    exposed = np.exp(logs)
    shot = np.sqrt(SHOT_NOISE * exposed + READ_NOISE) / exposed * slope / base_slope
    return np.sqrt((slope / (255 * np.sqrt(12))) ** 2 + shot**2 + (slope * spread) ** 2 + FLOOR**2)


def rises(response: Response) -> bool:
    """Return whether the response rises between its outer knots and is not flat over mid tones."""
    outer, middle = np.linspace(KNOTS[0], KNOTS[-1], 400), np.linspace(0.06, 0.94, 90)
    return all(
        np.all(np.diff(log_exposed(outer, one)[0]) > 0)
        and np.gradient(log_exposed(middle, one)[0], np.log(middle)).min() > SMALLEST_LOG_SLOPE
        for one in response.parts
    )


class Tables(NamedTuple):
    """Display values over equal steps of log x."""

    first: Float[np.ndarray, " r"]  # log x of the first entry of every row
    step: Float[np.ndarray, " r"]  # step of log x between entries
    values: Float[np.ndarray, "r n"]  # display values
    channels: int  # number of rows of a camera: 1 for all channels, or 3


@functools.lru_cache(64)
def _table(spline: Spline) -> tuple[float, float, np.ndarray]:
    y = np.linspace(DARKEST, 1.0, 4096)
    z = np.maximum.accumulate(log_exposed(y, Response("srgb", spline))[0])
    z = z + 1e-9 * np.arange(len(z))
    grid = np.linspace(z[0], z[-1], TABLE)
    return float(grid[0]), float(grid[1] - grid[0]), np.interp(grid, z, y)


def by_camera(cfg: PhotometryConfig) -> bool:
    """Return whether there are responses of single cameras."""
    return any(camera.splines for camera in cfg.cameras)


@functools.lru_cache(8)
def tables(cfg: PhotometryConfig) -> Tables:
    """Return the tables of all responses.

    With responses per camera, the last rows are for an unknown camera: the spline of all cameras,
    or otherwise the mean. Raises ValueError: there is no spline.
    """
    if cfg.spline is None and not by_camera(cfg):
        raise ValueError("the curve 'spline' needs the values of its spline")
    cameras = range(len(cfg.cameras) if by_camera(cfg) else 0)
    each = [spline_of(cfg, camera) for camera in (*cameras, UNKNOWN)]
    channels = max(map(len, each))
    splines = [row for rows in each for row in _rows(rows, channels)]
    first, step, values = zip(*map(_table, splines), strict=True)
    return Tables(np.array(first), np.array(step), np.array(values), channels)


def _rows(splines: tuple[Spline, ...], channels: int) -> tuple[Spline, ...]:
    return splines * channels if len(splines) == 1 else splines


def spline_of(cfg: PhotometryConfig, camera: int | None = None) -> tuple[Spline, ...]:
    """Return the spline of a camera (None, -1: unknown): a row for all channels, or one each."""
    splines = () if camera is None or camera < 0 else cfg.cameras[camera].splines
    if splines:
        return splines
    if cfg.spline is not None:
        return (cfg.spline,)
    others = [c.splines for c in cfg.cameras if c.splines]
    if not others:
        return ((0.0,) * len(KNOTS),)
    channels = max(map(len, others))
    mean = np.mean([_rows(s, channels) for s in others], 0)
    return tuple(tuple(map(float, row)) for row in mean)


def encode(log_linear: Values, cfg: PhotometryConfig, camera=None) -> Values:
    """Return display values from the table; linear in x below it, linear in log x above it.

    With responses per channel the last axis of `log_linear` is the channel. `camera` is a row
    in `cfg.cameras` (None: unknown): one for all, or one for each entry of all axes but the last.
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
    position = (log_linear - first) / step
    left = xp.clip(xp.floor(position), 0, TABLE - 2).astype(np.int32)
    values = xp.asarray(flat, log_linear.dtype)
    at = left if start is None else left + start
    # The last segment continues above the table, so that over-bright predictions have a gradient.
    inside = values[at] + (position - left) * (values[at + 1] - values[at])
    dark = position < 0
    below = dimmest * xp.exp(xp.where(dark, log_linear - first, 0.0))
    return xp.where(dark, below, inside)


def decode(y: Values, cfg: PhotometryConfig, camera=None) -> Values:
    """Return log exposed radiance from the tables of `encode`, constant beyond their ends."""
    xp, table = namespace(y, camera), tables(cfg)
    if not by_camera(cfg):
        logs = table.first[0] + table.step[0] * np.arange(TABLE)
        # numpy's interp computes and returns double precision.
        return xp.interp(y, table.values[0].astype(y.dtype), logs.astype(y.dtype)).astype(y.dtype)
    row = _row(table, camera, xp)
    values = xp.asarray(table.values.reshape(-1), y.dtype)
    # `interp` takes one table; this bisection searches many.
    left, span = xp.zeros(y.shape, np.int32), TABLE
    while span > 1:
        span //= 2
        left = xp.where(values[left + span + row * TABLE] <= y, left + span, left)
    left = xp.minimum(left, TABLE - 2)
    low, high = values[left + row * TABLE], values[left + 1 + row * TABLE]
    along = xp.clip((y - low) / xp.maximum(high - low, 1e-9), 0, 1)
    first, step = (xp.asarray(v, y.dtype)[row] for v in (table.first, table.step))
    return first + step * (left + along)


def _row(table: Tables, camera: Any, xp: Any) -> Int[Array, "..."]:
    """Return the row of every entry's table, with a shape that broadcasts with display values."""
    count = len(table.first) // table.channels
    row = xp.asarray(-1 if camera is None else camera)
    row = xp.where(row < 0, count - 1, row)[..., None]
    return (row * table.channels + np.arange(table.channels)).astype(np.int32)
