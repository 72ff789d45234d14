"""Videos made with PyAV; rotations, which it cannot write, are patched into the file."""

import functools
import struct
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

# ITU-T H.273: matrix, transfer function, primaries.
SDR, HLG, PQ = (1, 1, 1), (9, 18, 9), (9, 16, 9)
_TURNS = {90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


def write_video(
    path: Path,
    pictures: Iterable[np.ndarray],
    *,
    codec: str = "libx264",
    layout: str = "yuv420p",
    coding: tuple[int, int, int] = SDR,
    full: bool = False,
    times: Sequence[float] | None = None,
    quality: int = 10,
    options: dict[str, str] | None = None,
) -> None:
    """Write pictures, uint8 or uint16 R G B, as a video of 30 frames a second or at `times`, s.

    libx265 cannot be used: in 638 of 1,800 calls PyAV 18.1's returned packets that PyAV's muxer
    refuses, whatever the number of threads.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            codec, rate=30, options={"crf": str(quality)} | (options or {})
        )
        stream.pix_fmt = layout
        stream.time_base = Fraction(1, 600)
        context = stream.codec_context
        context.time_base = Fraction(1, 600)
        context.colorspace, context.color_trc, context.color_primaries = coding
        context.color_range = 2 if full else 1
        for k, picture in enumerate(pictures):
            source = "rgb24" if picture.dtype == np.uint8 else "rgb48le"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=source)
            if k == 0:
                stream.width, stream.height = frame.width, frame.height
            frame = frame.reformat(
                format=layout, dst_colorspace=coding[0], dst_color_range=2 if full else 1
            )
            frame.time_base = Fraction(1, 600)
            frame.pts = round(600 * (k / 30 if times is None else times[k]))
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def turn(path: Path, degrees: int) -> None:
    """Mark an .mp4 as rotated clockwise for display, as phones do."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    a, b, c, d = _TURNS[degrees]
    data[at : at + 36] = struct.pack(">9i", a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


_RNG = np.random.default_rng(0)
_TEXTURES = [
    cv2.resize(_RNG.integers(0, 255, (60, 240, 3), dtype=np.uint8), (2400, 600)) for _ in range(2)
]


@functools.cache
def room(position: float) -> np.ndarray:
    """Return the picture of a camera at a sideways position, metres, in a made room.

    A textured wall stands at 4 m, and textured posts before it at 2 m.
    """
    width, height = 240, 136
    focal = 0.85 * width
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    out = np.zeros((height, width, 3), np.float32)
    for depth, texture in ((4.0, _TEXTURES[0]), (2.0, _TEXTURES[1])):
        across, up = x / focal * depth + position, y / focal * depth
        u, v = (across + 6) * 200, (up + 1.5) * 200
        seen = cv2.remap(
            texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_WRAP,
        )  # fmt: skip
        solid = np.ones_like(across, bool) if depth == 4 else (across % 1.0) < 0.3
        out = np.where(solid[..., None], seen, out)
    return out.astype(np.uint8)
