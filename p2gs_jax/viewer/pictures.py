"""Pictures of a rendered frame in every mode of the viewer, with legends, and as files."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import matplotlib
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, UInt8

from p2gs_jax.formats.exr import write_exr
from p2gs_jax.formats.false_color import DEPTH_MAP, STOPS, STOPS_MAP, depth_color, false_color
from p2gs_jax.formats.frames import to_uint8
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.formation import places
from p2gs_jax.types import Camera

Mode = Literal["display", "stops", "depth", "split"]
# Exposed radiance at 0 stops.
MIDDLE_GREY = 0.18
# Percentiles of depth at the ends of the colour scale.
DEPTH_TAILS = (1.0, 99.0)
LINE = 1.0  # display value of the split's line
# Smallest and largest width of a saved picture, pixels.
SAVED_WIDTHS = (16, 16384)
BOX = "margin:0 0.75em 0.75em;font-size:0.75em;line-height:1.4;opacity:0.9"
COLORS = 12  # colours of the gradient of a legend


@dataclass(frozen=True)
class RenderedFrame:
    """A rendered view, the source of every mode; depth is camera z times alpha, scene units."""

    linear: Float[Array, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    camera: Camera

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.camera.width, self.camera.height


class WarpedPhotograph(NamedTuple):
    """Display values of a photograph in the pixels of a frame, and the mask of covered pixels."""

    ldr: Float32[np.ndarray, "h w 3"]
    inside: Bool[np.ndarray, "h w"]


def picture_of(
    frame: RenderedFrame,
    mode: Mode,
    transform: DisplayTransform,
    *,
    depth_limits: tuple[float, float] | None = None,
    photograph: WarpedPhotograph | None = None,
    split: float = 0.5,
    vignetting_camera: Camera | None = None,
) -> Float32[np.ndarray, "h w 3"]:
    """Return display values of a frame in one of the modes.

    Args:
        mode: `stops` counts from mid-grey at the exposure of the transform; `split` without
            a photograph equals `display`.
        depth_limits: ends of the colour scale, scene units; None: `limits_of_depth`.
        split: visible share of the photograph's width, from the left.
        vignetting_camera: the camera of the transform's vignetting; None: the frame's camera.
    """
    if mode == "stops":
        return false_color(np.asarray(frame.linear), MIDDLE_GREY / transform.exposure)
    if mode == "depth":
        return depth_color(frame.depth, frame.alpha, depth_limits or limits_of_depth(frame))
    positions = None
    if vignetting_camera is not None and transform.vignetting:
        positions = places_in(vignetting_camera, frame.camera)
    ldr = develop(frame.linear, transform, positions, frame.alpha)
    return ldr if mode == "display" or photograph is None else split_picture(photograph, ldr, split)


def places_in(vignetting_camera: Camera, frame: Camera) -> Float32[np.ndarray, "h w 2"]:
    """Return the positions of the frame's pixels in a photograph, half diagonals from its centre.

    Positions beyond 1 are moved to 1, the radius of the corners, where vignetting ends.
    """
    K, k = np.asarray(vignetting_camera.K, float), np.asarray(frame.K, float)
    x, y = ((np.arange(n) + 0.5) for n in (frame.width, frame.height))
    u = (x - k[0, 2]) / k[0, 0] * K[0, 0] + K[0, 2]
    v = (y - k[1, 2]) / k[1, 1] * K[1, 1] + K[1, 2]
    at = places(np.stack(np.meshgrid(u, v), -1), vignetting_camera.width, vignetting_camera.height)
    return (at / np.maximum(np.linalg.norm(at, axis=-1, keepdims=True), 1)).astype(np.float32)


def split_picture(
    photograph: WarpedPhotograph, ldr: Float32[np.ndarray, "h w 3"], split: float
) -> Float32[np.ndarray, "h w 3"]:
    """Return the photograph to the left of a white line, and the render everywhere else.

    The distance of the line from the photograph's left edge is `split` times its width.
    """
    out = np.array(ldr)
    columns = np.flatnonzero(photograph.inside.any(0))
    if not len(columns):
        return out
    first, last = int(columns[0]), int(columns[-1]) + 1
    line = first + round(split * (last - first))
    left = photograph.inside.copy()
    left[:, line:] = False
    out[left] = photograph.ldr[left]
    if first < line < last:
        out[:, line - 1 : line + 1] = LINE
    return out


def limits_of_depth(frame: RenderedFrame) -> tuple[float, float]:
    """Return the 1st and 99th percentile of a frame's depth, scene units."""
    alpha, depth = frame.alpha[::4, ::4], frame.depth[::4, ::4]
    solid = alpha > 0.5
    if not solid.any():
        return 1.0, 2.0
    near, far = np.percentile(depth[solid] / alpha[solid], DEPTH_TAILS)
    return max(float(near), 1e-6), max(float(far), 1.001 * float(near), 2e-6)


def warp_photograph(
    ldr: Float32[np.ndarray, "h w 3"],
    mask: Float32[np.ndarray, "h w"],
    camera: Camera,
    frame: Camera,
) -> WarpedPhotograph:
    """Return a photograph resampled to the pixels of another camera at the same position.

    Images of cameras with a common centre are related by a homography. `mask` is 1 where the
    photograph counts.
    """
    turn = np.asarray(camera.viewmat, float)[:3, :3] @ np.asarray(frame.viewmat, float)[:3, :3].T
    K, k = np.asarray(camera.K, float), np.asarray(frame.K, float)
    # OpenCV's first pixel centre is at 0, ours at 0.5.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    pull = np.linalg.inv(half) @ K @ turn @ np.linalg.inv(k) @ half  # frame to photograph
    size = (frame.width, frame.height)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shrink = _minification(pull, size)
    if shrink > 1.0:
        small = (max(1, round(camera.width / shrink)), max(1, round(camera.height / shrink)))
        ldr = cv2.resize(ldr, small, interpolation=cv2.INTER_AREA)
        mask = cv2.resize(mask, small, interpolation=cv2.INTER_AREA)
        scale = np.diag([small[0] / camera.width, small[1] / camera.height, 1.0])
        pull = np.linalg.inv(half) @ scale @ half @ pull
    pixels = cv2.warpPerspective(ldr, pull, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    inside = cv2.warpPerspective(mask, pull, size, flags=flags) > 0.5
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    behind = pull[2, 0] * x + pull[2, 1] * y + pull[2, 2] <= 0
    return WarpedPhotograph(pixels.astype(np.float32), inside & ~behind)


def _minification(pull: Float[np.ndarray, "3 3"], size: tuple[int, int]) -> float:
    """Return the number of photograph pixels per frame pixel at the middle of the frame."""
    middle = np.array([size[0] / 2, size[1] / 2, 1.0])
    steps = (middle + np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])) @ pull.T
    at = steps[:, :2] / np.where(np.abs(steps[:, 2:]) < 1e-9, 1e-9, steps[:, 2:])
    return float(min(np.hypot(*(at[1] - at[0])), np.hypot(*(at[2] - at[0]))))


def png_bytes(ldr: Float32[np.ndarray, "h w 3"]) -> bytes:
    """Return display values as a PNG file."""
    return cv2.imencode(".png", to_uint8(ldr)[..., ::-1])[1].tobytes()


def exr_bytes(frame: RenderedFrame, transform: DisplayTransform) -> bytes:
    """Return a frame as an EXR file with depth, opacity, display transform and camera."""
    with tempfile.TemporaryDirectory(prefix="p2gs-view-") as folder:
        path = Path(folder) / "view.exr"
        write_exr(
            path,
            np.asarray(frame.linear),
            depth=frame.depth,
            alpha=frame.alpha,
            transform=transform,
            camera=frame.camera,
        )
        return path.read_bytes()


def stops_legend() -> str:
    """Return the legend of the mode `stops` as HTML, with one box per stop."""
    low, high = (int(limit) for limit in STOPS)
    values = 2.0 ** (np.arange(low, high) + 0.5)
    colors = false_color(np.repeat(values[None, :, None], 3, -1).astype(np.float32), 1.0)[0]
    cells = [
        f'<div style="flex:1;text-align:center;background:{_css(color)};'
        f'color:{"black" if float(np.mean(color)) > 0.45 else "white"}">'
        f"{f'{stop:+d}' if stop else '0'}</div>"
        for stop, color in zip(range(low, high), colors, strict=True)
    ]
    text = "stops from mid-grey at this exposure; each box is the stop above its number"
    return note(f'<div style="display:flex">{"".join(cells)}</div>', text)


def depth_legend(near: float, far: float) -> str:
    """Return the legend of the mode `depth` as HTML; its ends are in scene units."""
    return _scale(DEPTH_MAP, (1, 0), f"{near:.3g}", f"{far:.3g}", "depth, scene units")


def exposure_legend(low: float, high: float) -> str:
    """Return the legend of `exposure_colors` as HTML; its ends are in stops."""
    text = "exposure, stops (EV) from the mean; grey: held-out view"
    return _scale(STOPS_MAP, (0, 1), f"{low:+.1f}", f"{high:+.1f}", text)


def exposure_colors(evs: Sequence[float | None]) -> UInt8[np.ndarray, "n 3"]:
    """Return a colour for each exposure, lighter for larger ones, and grey for None."""
    known = [ev for ev in evs if ev is not None]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    out = np.full((len(evs), 3), 128, np.uint8)
    for row, ev in enumerate(evs):
        if ev is not None:
            share = (ev - low) / (high - low) if high > low else 0.5
            out[row] = np.rint(255 * np.array(matplotlib.colormaps[STOPS_MAP](float(share))[:3]))
    return out


def note(*lines: str) -> str:
    """Return short lines as HTML for the space below a control."""
    return f'<div style="{BOX}">' + "".join(f"<div>{line}</div>" for line in lines) + "</div>"


def _scale(colormap: str, ends: tuple[float, float], left: str, right: str, text: str) -> str:
    stops = ",".join(map(_css, matplotlib.colormaps[colormap](np.linspace(*ends, COLORS))[:, :3]))
    return note(
        f'<div style="height:0.9em;background:linear-gradient(to right,{stops})"></div>',
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{left}</span><span>{right}</span></div>",
        text,
    )


def _css(color: Sequence[float]) -> str:
    return "rgb({},{},{})".format(*(round(255 * float(c)) for c in color))
