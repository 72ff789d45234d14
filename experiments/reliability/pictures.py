"""Photographs of many kinds as bytes, whole ones and such that say more than they hold."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from PIL import Image
from reliability.mutations import Broken

KINDS = ("png", "jpg", "tif", "bmp", "webp", "ppm")
_FORMATS = {"jpg": "jpeg", "tif": "tiff"}


def encoded(image: Image.Image, kind: str, **options: Any) -> bytes:
    """Return a picture as a file of a kind, `png` for instance."""
    out = io.BytesIO()
    image.save(out, _FORMATS.get(kind, kind), **options)
    return out.getvalue()


def noise(width: int, height: int, channels: int = 3, seed: int = 0) -> Image.Image:
    """Return a picture of noise."""
    rng = np.random.default_rng(seed)
    shape = (height, width) if channels == 1 else (height, width, channels)
    return Image.fromarray(rng.integers(0, 256, shape, np.uint8))


def png_header(width: int, height: int, depth: int, colour: int) -> bytes:
    """Return signature and header of a PNG."""
    said = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", said)


def chunk(kind: bytes, data: bytes) -> bytes:
    """Return a part of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@cache
def black_png(width: int, height: int, depth: int = 8, colour: int = 0) -> bytes:
    """Return a black PNG of any size, made without the picture."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    line = bytes(1 + (width * depth * channels + 7) // 8)
    packer = zlib.compressobj(1)
    data = b"".join(packer.compress(line) for _ in range(height)) + packer.flush()
    palette = chunk(b"PLTE", bytes(3)) if colour == 3 else b""
    start = png_header(width, height, depth, colour)
    return start + palette + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def with_chunk(png: bytes, kind: bytes, data: bytes) -> bytes:
    """Return a PNG with a part more, behind its header."""
    return png[:33] + chunk(kind, data) + png[33:]


def only_headers(width: int, height: int) -> Iterator[tuple[str, Broken]]:
    """Yield suffixes and files that announce a size and hold next to nothing."""
    said = f"header only, {width}x{height}"
    yield "png", Broken(said, png_header(width, height, 8, 2) + chunk(b"IDAT", b"x"))
    yield "ppm", Broken(said, f"P6 {width} {height} 255\n".encode() + bytes(100))
    bitmap = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    yield "bmp", Broken(said, b"BM" + struct.pack("<IHHI", 154, 0, 0, 54) + bitmap + bytes(100))
    if width < 65536 and height < 65536:
        jpeg = encoded(noise(16, 16), "jpg")
        at = jpeg.index(b"\xff\xc0") + 5
        yield "jpg", Broken(said, jpeg[:at] + struct.pack(">HH", height, width) + jpeg[at + 4 :])
    tags = ((256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 200), (277, 1))
    rows = b"".join(
        struct.pack("<HHII", tag, 4, 1, value)
        for tag, value in (*tags, (278, height), (279, min(width * height, 2**32 - 1)))
    )
    tiff = b"II*\0" + struct.pack("<IH", 8, 9) + rows + bytes(200)
    yield "tif", Broken(said, tiff)


def bomb(kind: bytes, size: int) -> bytes:
    """Return a PNG with a part, a colour profile or a comment, that unpacks to many bytes."""
    png = encoded(noise(48, 32), "png")
    return with_chunk(png, kind, b"Comment\0\0" + zlib.compress(bytes(size), 9))


def with_exif(width: int, height: int) -> bytes:
    """Return a JPEG with settings of a shot."""
    exif = Image.Exif()
    exif[0x010F] = "maker"
    exif.get_ifd(0x8769).update({0x829A: 0.01, 0x829D: 2.8, 0x8827: 100, 0x920A: 35.0})
    return encoded(noise(width, height), "jpg", exif=exif)
