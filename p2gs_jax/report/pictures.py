"""Pictures in the page, as data URLs."""

from __future__ import annotations

import base64
import html

import cv2
import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.formats.false_color import STOPS, false_color, luminance, stops
from p2gs_jax.formats.png import to_uint8

# Largest width, pixels: a third of the page on a screen of twice its resolution, and all of it.
SMALL, LARGE = 560, 900
JPEG_QUALITY = 84
# A difference of 1 / GAIN of the display's range is shown as white or black.
GAIN = 4.0


def shrunk(image: Float[np.ndarray, "h w c"], width: int) -> Float[np.ndarray, "h2 w2 c"]:
    """Return an image of at most `width` pixels across."""
    h, w = image.shape[:2]
    if w <= width:
        return image
    size = (width, max(1, round(h * width / w)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def jpeg(ldr: Float[np.ndarray, "h w 3"], alt: str, width: int = SMALL) -> str:
    """Return an `img` element of display values; NaN becomes black."""
    return _element(".jpg", "jpeg", shrunk(_clamped(ldr), width), alt)


def png(ldr: Float[np.ndarray, "h w 3"], alt: str) -> str:
    """Return an `img` element without loss: for flat colours, which JPEG would smear."""
    return _element(".png", "png", np.asarray(ldr, np.float32), alt)


def _clamped(image: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(np.asarray(image, np.float32)), 0, 1)


def _element(suffix: str, kind: str, image: np.ndarray, alt: str) -> str:
    codes = to_uint8(image)[..., ::-1]
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if kind == "jpeg" else []
    good, data = cv2.imencode(suffix, codes, options)
    assert good
    text = base64.b64encode(data.tobytes()).decode("ascii")
    (h, w), alt = image.shape[:2], html.escape(alt)
    return f'<img src="data:image/{kind};base64,{text}" width="{w}" height="{h}" alt="{alt}">'


def signed_difference(
    render: Float[np.ndarray, "h w 3"], photograph: Float[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return render minus photograph in luminance: grey where they agree, lighter where the render
    is too bright."""
    gap = luminance(_clamped(render)) - luminance(_clamped(photograph))
    shown = np.clip(0.5 + 0.5 * GAIN * gap, 0, 1)
    return np.repeat(shown[..., None], 3, -1).astype(np.float32)


def stop_picture(
    linear: Float[np.ndarray, "h w 3"], middle: float, width: int = SMALL
) -> Float32[np.ndarray, "h w 3"]:
    """Return false colour in whole stops from `middle`, a luminance."""
    return false_color(shrunk(np.maximum(np.nan_to_num(linear), 0), width), middle)


def stop_shares(
    linear: Float[np.ndarray, "h w 3"], middle: float
) -> list[tuple[int, float, tuple[float, float, float]]]:
    """Return (lower end of the stop, share of the pixels, colour), the brightest first.

    The first and the last hold everything beyond them.
    """
    low, high = (round(v) for v in STOPS)
    whole = np.clip(np.floor(stops(np.nan_to_num(linear), middle)), low, high - 1).astype(int)
    counts = np.bincount((whole - low).ravel(), minlength=high - low) / whole.size
    out = []
    for stop in range(high - 1, low - 1, -1):
        level = np.full((1, 1, 3), middle * 2.0 ** (stop + 0.5), np.float32)
        red, green, blue = (float(v) for v in false_color(level, middle)[0, 0])
        out.append((stop, float(counts[stop - low]), (red, green, blue)))
    return out


def dynamic_range(linear: Float[np.ndarray, "h w 3"]) -> float:
    """Return the stops between the 0.5th and the 99.5th percentile of luminance."""
    values = luminance(np.nan_to_num(linear))
    values = values[values > 1e-9]
    if values.size == 0:
        return 0.0
    low, high = np.percentile(values, (0.5, 99.5))
    return float(np.log2(high / low))
