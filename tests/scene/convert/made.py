"""Photographs in the formats of cameras, byte by byte where no library writes them."""

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pillow_heif
from PIL import ExifTags, Image, TiffImagePlugin

# Linear sRGB to the made camera's colours, which are XYZ: LibRaw inverts this itself.
_XYZ_TO_CAMERA = (
    *(3.2404542, -1.5371385, -0.4985314),
    *(-0.9692660, 1.8760108, 0.0415560),
    *(0.0556434, -0.2040259, 1.0572252),
)
_BALANCE = (2.0, 1.0, 1.5)  # the sensor's white balance
DISPLAY_P3_XYZ = (
    (0.51512, 0.2412, -0.00105),
    (0.29198, 0.69225, 0.04189),
    (0.1571, 0.06657, 0.78407),
)
ADOBE_RGB_XYZ = (
    (0.60974, 0.31111, 0.01947),
    (0.20528, 0.62567, 0.06087),
    (0.14919, 0.06322, 0.74457),
)


def write_dng(
    path: Path,
    light: np.ndarray,
    *,
    chosen: tuple[float, float, float] = _BALANCE,
    orientation: int = 1,
    time: tuple[int, int] = (1, 60),
    iso: int = 200,
) -> None:
    """Write light as an RGGB sensor sees it; `chosen` is the camera's white balance."""
    h, w = light.shape[:2]
    camera = np.minimum(light / _BALANCE, 1)
    channel = np.array([[0, 1], [1, 2]])[np.indices((h, w))[0] % 2, np.indices((h, w))[1] % 2]
    seen = np.take_along_axis(camera, channel[..., None], 2)[..., 0]
    data = np.rint(512 + seen * (16383 - 512)).astype("<u2")
    fraction = TiffImagePlugin.IFDRational
    neutral = [fraction(round(1e6 / b), 1_000_000) for b in chosen]
    matrix = [fraction(round(v * 1e6), 1_000_000) for v in _XYZ_TO_CAMERA]
    shot = {33434: fraction(*time), 33437: 2.8, 34855: iso, 37386: 50.0}
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, (kind, value) in {
        **{271: (2, "Made"), 272: (2, "Made One"), 274: (3, orientation), 34665: (4, shot)},
        **{33421: (3, (2, 2)), 33422: (1, b"\0\1\1\2"), 50706: (1, b"\1\4\0\0")},
        **{50708: (2, "Made One"), 50714: (3, 512), 50717: (4, 16383), 50778: (3, 21)},
        **{50721: (10, tuple(matrix)), 50728: (5, tuple(neutral))},
    }.items():
        tags.tagtype[tag] = kind
        tags[tag] = value
    file = io.BytesIO()
    Image.fromarray(data).save(file, "TIFF", tiffinfo=tags)
    # Pillow tags the pixels as grey (1); they are of a colour filter array (32803).
    grey, filtered = (struct.pack("<HHII", 262, 3, 1, kind) for kind in (1, 32803))
    path.write_bytes(file.getvalue().replace(grey, filtered))


def icc_profile(name: str, columns, curve: bytes) -> bytes:
    """Return a profile of a matrix and one curve for all channels."""

    def xyz(values) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(v * 65536) for v in values))

    text = name.encode("utf-16-be")
    mluc = b"mluc\0\0\0\0" + struct.pack(">II", 1, 12) + b"enUS" + struct.pack(">II", len(text), 28)
    tags = {
        b"desc": mluc + text,
        b"wtpt": xyz((0.9642, 1.0, 0.8249)),
        **{key: xyz(c) for key, c in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns, strict=True)},
        **dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve),
    }
    at, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for key, data in tags.items():
        data += b"\0" * (-len(data) % 4)
        table += struct.pack(">4sII", key, at + len(body), len(data))
        body += data
    header = bytearray(128)
    header[:4] = struct.pack(">I", at + len(body))
    header[8:24] = b"\x04\x30\0\0mntrRGB XYZ "
    header[36:40] = b"acsp"
    header[68:80] = struct.pack(">3i", 63190, 65536, 54061)
    return bytes(header) + table + body


def parametric(*values: float) -> bytes:
    """Return the curve (a x + b)^g where x >= d, else c x; or x^g."""
    kind = 0 if len(values) == 1 else 3
    fixed = (round(v * 65536) for v in values)
    return b"para\0\0\0\0" + struct.pack(">HH", kind, 0) + struct.pack(f">{len(values)}i", *fixed)


SRGB_CURVE = parametric(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
DISPLAY_P3 = icc_profile("Display P3", DISPLAY_P3_XYZ, SRGB_CURVE)
ADOBE_RGB = icc_profile("Adobe RGB (1998)", ADOBE_RGB_XYZ, parametric(563 / 256))


def write_exr(path: Path, light: np.ndarray, names: str = "RGB", **header) -> None:
    channels = {c: np.ascontiguousarray(light[..., i]) for i, c in enumerate(names)}
    with OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, channels) as file:
        file.write(str(path))


def save_heic(path: Path, pixels: np.ndarray, **options) -> None:
    mode = "RGB;16" if pixels.dtype == np.uint16 else "RGB"
    data = np.ascontiguousarray(pixels).tobytes()
    image = pillow_heif.from_bytes(mode, pixels.shape[1::-1], data)
    image.save(path, quality=100, chroma=444, **options)


def settings() -> Image.Exif:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Made", "One"
    exif.get_ifd(ExifTags.IFD.Exif).update({0x829A: 1 / 60, 0x829D: 2.8, 0x8827: 200})
    return exif


def patches() -> np.ndarray:
    """Return a smooth coloured picture, float in [0, 1]."""
    small = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)
    return np.clip(cv2.resize(small, (96, 64), interpolation=cv2.INTER_CUBIC), 0, 1)
