"""The conversion of photographs to one exposure: display values to radiance, and back.

A stored value goes through the inverse curve of its view to radiance (response, gamma, exposure,
white balance, vignetting; docs/photometry.md, 1), and back through one curve for all views: the
common exposure, the mean gamma, the mean response, neutral white balance, no vignetting. Everything
but vignetting is a table from stored values to stored values.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt, UInt8, UInt16

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry import formation
from p2gs_jax.photometry.response import DARKEST, by_camera
from p2gs_jax.scene.lens import undistort_points
from p2gs_jax.types import GAMMA_SRGB, Capture, View

# Steps of the common curve in log radiance: each is at most 0.4 of a 16-bit code at gamma 2.2.
_STEPS = 2**20
# Entries of the table of vignetting over r^2, and rows of pixels that are converted at a time.
_RADII, _ROWS = 2**16, 64
# Intervals of the grid, along each side of a photograph, that is undistorted for r^2.
_INTERVALS = 128

Pixels = UInt[np.ndarray, "h w 3"]
Logs = Float32[np.ndarray, "*n 3"]
Finish = Callable[[Logs], Any]
"""A function from log radiance (natural, -inf for black) to output values."""


def common_curve(log_exposure: float, gamma: float, cfg: PhotometryConfig, most: int) -> Finish:
    """Return the function from natural log radiance to values; `most` is the value of white."""
    white = formation.inverse_tone_map(np.ones(3), gamma, cfg, None).max()
    first, last = np.log(formation.EXPOSED_FLOOR), np.log(white)
    exposed = np.exp(np.linspace(first, last, _STEPS))[:, None]
    exposed = np.repeat(exposed, 3 if by_camera(cfg) else 1, 1)  # columns of separate responses
    display = formation.display(formation.tone_map(exposed, gamma, cfg, None))
    values = np.rint(most * display).astype(np.uint16)
    values[0] = 0
    steps_per_log = (_STEPS - 1) / (last - first)

    def codes(logs: Logs) -> UInt16[np.ndarray, "*n 3"]:
        position = logs * np.float32(steps_per_log)
        position += np.float32((log_exposure - first) * steps_per_log)
        index = np.clip(position, 0, _STEPS - 1, out=position).astype(np.int32)
        if values.shape[1] == 1:
            return values[:, 0][index]
        return np.stack([values[index[..., c], c] for c in range(3)], -1)

    return codes


@dataclass(frozen=True)
class Film:
    """The inverse curve of one photograph, from stored values to log radiance."""

    view: View
    logs: Float32[np.ndarray, "levels 3"]  # log radiance of every stored value, without vignetting
    shade: Float32[np.ndarray, "r k"] | None  # log V over r^2, k = 1 or 3 channels
    white: int  # smallest stored value that counts as clipped

    @classmethod
    def of(
        cls, view: View, capture: Capture, top: int, cfg: PhotometryConfig, saturation: float
    ) -> Film:
        """Return the curve of values 0 to `top`; display values >= `saturation` are clipped."""
        values = np.repeat((np.arange(1, top + 1) / top)[:, None], 3, 1)
        logs = np.log(formation.inverse_formation(values, capture, cfg, np.zeros((top, 2))))
        # Below half an 8-bit code the curves are continued as a power of the value.
        steepness = float(capture.gamma) / (1 if cfg.curve == "power" else GAMMA_SRGB)
        logs += steepness * np.log(np.minimum(values / DARKEST, 1.0))
        logs, shade = np.concatenate([np.full((1, 3), -np.inf), logs]), None
        if capture.camera is not None:
            squared = np.linspace(0, 1, _RADII, dtype=np.float32)
            shade = formation.log_vignetting(squared, capture.camera, cfg)
        shaded = shade is not None and shade.any()
        white = int(np.ceil(saturation * top - 1e-6))
        return cls(view, logs.astype(np.float32), shade if shaded else None, white)

    def most(self) -> float:
        """Return the largest log radiance of an unclipped value at any place of the photograph."""
        darkest = 0.0 if self.shade is None else min(0.0, float(self.shade.min()))
        return float(self.logs[self.white - 1].max()) - darkest

    def changes_nothing(self, finish: Finish) -> bool:
        """Return whether `finish`, whose white is 255 * 256, maps every 8-bit value to itself."""
        table = finish(self.logs)
        same = np.arange(len(table))[:, None] * 256
        return self.shade is None and len(table) == 256 and bool((table == same).all())

    def developed(self, pixels: Pixels, finish: Finish) -> np.ndarray:
        """Return `finish` of the log radiance of every pixel.

        If the curves of channels differ, pixels that are clipped in all channels become neutral:
        their channels get the largest of their values, since each is a lower bound of the light.
        """
        table = finish(self.logs)
        out = np.empty(pixels.shape, table.dtype)
        tinted = np.ptp(self.logs[-1]) > 1e-3 or (
            self.shade is not None and self.shade.shape[1] > 1
        )
        squared = None if self.shade is None else squared_radii(self.view, *pixels.shape[:2])
        for rows, block in _blocks(pixels):
            if self.shade is None or squared is None:
                found = _looked_up(block, table)
            else:
                entry = (squared[rows] * np.float32(_RADII - 1)).astype(np.uint16)
                found = finish(_looked_up(block, self.logs) - self.shade[entry])
            if tinted:
                clipped = across(np.minimum, block) >= self.white
                found[clipped] = found[clipped].max(1, keepdims=True)
            out[rows] = found
        return out


def squared_radii(view: View, height: int, width: int) -> Float32[np.ndarray, "h w"]:
    """Return r^2 of the pixels of a photograph of any size: that of their undistorted positions.

    Vignetting is solved and rendered in undistorted images. Outside of these it continues with its
    value in their corners.
    """
    if view.distortion is None:
        return formation.squared_radii(height, width)
    x, y = (np.linspace(0, side, _INTERVALS + 1) for side in (view.width, view.height))
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    straight = undistort_points(nodes, view.K, view.distortion)
    squared = (formation.places(straight, view.width, view.height) ** 2).sum(-1)
    known = np.where(np.isfinite(squared), np.minimum(squared, 1), 1).astype(np.float32)
    columns = _interpolated(known.reshape(_INTERVALS + 1, -1).T, width)
    return _interpolated(np.ascontiguousarray(columns.T), height)


def _interpolated(nodes: Float32[np.ndarray, "n k"], size: int) -> Float32[np.ndarray, "s k"]:
    """Return values at the centres of `size` pixels from values at the ends of equal intervals."""
    position = (np.arange(size) + 0.5) * ((len(nodes) - 1) / size)
    low = position.astype(int)
    share = (position - low).astype(np.float32)[:, None]
    return nodes[low] * (1 - share) + nodes[low + 1] * share


def dithered(codes: UInt16[np.ndarray, "h w 3"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return 16-bit codes as 8-bit codes: noise below one 8-bit code is added before rounding down.

    The photograph's name is the seed of the noise. Multiples of 256 become their 8-bit code.
    """
    rng = np.random.Generator(np.random.SFC64(zlib.crc32(name.encode())))
    out = np.empty(codes.shape, np.uint8)
    for rows, block in _blocks(codes):
        out[rows] = (block + rng.integers(0, 256, block.shape, np.uint8)) >> 8
    return out


def across(extreme: Callable[..., Any], pixels: Pixels) -> UInt[np.ndarray, "h w"]:
    """Return np.maximum or np.minimum of three channels; NumPy's reductions take far longer."""
    return extreme(extreme(pixels[..., 0], pixels[..., 1]), pixels[..., 2])


def _blocks(pixels: Pixels) -> Iterator[tuple[slice, Pixels]]:
    """Yield the rows and pixels of blocks that fit into a processor's cache."""
    for begin in range(0, len(pixels), _ROWS):
        rows = slice(begin, begin + _ROWS)
        yield rows, pixels[rows]


def _looked_up(pixels: Pixels, table: Any) -> Any:
    """Return the entry of every stored value in its channel's column of a table."""
    if pixels.dtype == np.uint8:
        # Indexing with NumPy takes three times as long.
        return cv2.LUT(np.ascontiguousarray(pixels), table[None])
    return np.stack([table[pixels[..., c], c] for c in range(3)], -1)
