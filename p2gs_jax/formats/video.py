"""H.264 videos."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
from jaxtyping import Float32

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.formats.png import to_uint8

# Constant quality: at 16 compression is hardly visible.
QUALITY = "16"
SMALLEST = 16

AddFrame = Callable[[Float32[np.ndarray, "h w 3"]], None]


@contextlib.contextmanager
def open_video(path: Path, width: int, height: int, fps: float) -> Iterator[AddFrame]:
    """Yield a function that appends display values in [0, 1]; the file appears at the end.

    Smaller frames are centred on black. The size is rounded down to even numbers, as the codec
    requires. Display values are tagged as BT.709 primaries with the sRGB curve.

    Args:
        path: of the .mp4.
        width: of the largest frame, pixels.
        height: of the largest frame, pixels.
        fps: frames per second.

    Raises:
        UserError: the size is too small, or no encoder was built into PyAV.
    """
    size = (width // 2 * 2, height // 2 * 2)
    if min(size) < SMALLEST:
        raise UserError(
            f"{path}: {width}x{height} pixels are too few for a video.",
            fix=f"choose a larger --width, so that both are at least {SMALLEST}",
        )
    if "libx264" not in av.codecs_available:
        raise UserError(
            "This build of PyAV cannot encode H.264.",
            fix="install the wheel of `av` from PyPI, or write frames into a folder",
        )
    # The index comes first, so that browsers can play a file while it loads.
    options = {"movflags": "+faststart"}
    with (
        atomic_write(path) as temporary,
        av.open(str(temporary), "w", options=options) as container,
    ):
        rate = Fraction(fps).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": QUALITY})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        context = stream.codec_context
        context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
        context.color_primaries = ColorPrimaries.BT709
        context.color_trc = ColorTrc.IEC61966_2_1

        def add(ldr: Float32[np.ndarray, "h w 3"]) -> None:
            frame = av.VideoFrame.from_ndarray(_codes(ldr, size), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode(None))


def _codes(ldr: Float32[np.ndarray, "h w 3"], size: tuple[int, int]) -> np.ndarray:
    """Return 8-bit values, centred and cut to the size of the video."""
    codes = to_uint8(ldr)
    width, height = size
    codes = codes[:height, :width]
    above, before = (height - codes.shape[0]) // 2, (width - codes.shape[1]) // 2
    out = np.zeros((height, width, 3), np.uint8)
    out[above : above + codes.shape[0], before : before + codes.shape[1]] = codes
    return out
