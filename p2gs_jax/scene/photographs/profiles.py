"""Colour profiles in photographs, and colours brought from them to sRGB.

Only profiles made of a matrix and a curve per channel are applied (ICC.1:2022, 8.3.3): all that
cameras and phones write are. Of others the photograph is used as it is, which `fit` says.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt
from PIL import Image

from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.scene.photographs.light import ADOBE_RGB, BT709, adapted, rgb_to_xyz

# The white of the profile connection space, D50.
_PCS_WHITE = np.array([0.9642, 1.0, 0.8249])
# Colours that move by less than this, display values, are sRGB's.
_INVISIBLE = 0.004
_INTEROPERABILITY, _INTEROP_INDEX = 0xA005, 1
# How DCF marks Adobe RGB where there is no profile.
_DCF_OPTION = "R03"
_ENTRIES = 1024


@dataclass(frozen=True)
class Profile:
    """A colour space of photographs other than sRGB.

    Attributes:
        name: as the profile describes itself.
        decode: light of `_ENTRIES` evenly spaced values from 0 to 1 by channel; None: colours are
            looked up in tables, which is not done here.
        matrix: from that light to linear sRGB.
    """

    name: str
    decode: Float[np.ndarray, "n 3"] | None = None
    matrix: Float[np.ndarray, "3 3"] | None = None


def profile_of(image: Image.Image) -> Profile | None:
    """Return the colour space of an opened photograph; None: sRGB, grey or unknown.

    Args:
        image: opened by Pillow; its pixels are not read.
    """
    data = image.info.get("icc_profile")
    if data:
        return read_profile(bytes(data))
    try:
        index = image.getexif().get_ifd(_INTEROPERABILITY).get(_INTEROP_INDEX)
    except Exception:  # malformed EXIF raises many kinds of errors
        return None
    return adobe_rgb() if str(index).strip("\0 ") == _DCF_OPTION else None


def adobe_rgb() -> Profile:
    """Return Adobe RGB (1998)."""
    curve = np.linspace(0, 1, _ENTRIES)[:, None] ** (563 / 256)
    matrix = np.linalg.inv(rgb_to_xyz(BT709)) @ rgb_to_xyz(ADOBE_RGB)
    return Profile("Adobe RGB (1998)", np.repeat(curve, 3, 1), matrix)


def read_profile(data: bytes) -> Profile | None:
    """Return the colour space that an ICC profile describes; None: sRGB, grey or broken.

    Args:
        data: the profile.
    """
    try:
        tags = _tags(data)
        if data[16:20] != b"RGB ":
            return None
        name = _text(tags.get(b"desc", b"")) or "unnamed"
        if not {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"} <= tags.keys():
            return Profile(name)
        columns = [_xyz(tags[key]) for key in (b"rXYZ", b"gXYZ", b"bXYZ")]
        curves = [_curve(tags[key]) for key in (b"rTRC", b"gTRC", b"bTRC")]
    except (struct.error, ValueError, IndexError):
        return None
    srgb = rgb_to_xyz(BT709)
    matrix = np.linalg.inv(srgb) @ adapted(_PCS_WHITE, srgb.sum(1)) @ np.stack(columns, 1)
    profile = Profile(name, np.stack(curves, 1), matrix)
    return None if _is_srgb(profile) else profile


def to_srgb(pixels: UInt[np.ndarray, "h w 3"], profile: Profile) -> UInt[np.ndarray, "h w 3"]:
    """Return colours in sRGB as 16 bits: 8 would be rounded twice.

    What sRGB cannot show is clipped: such channels count as black or saturated, as if the camera
    had written sRGB.

    Args:
        pixels: unsigned integers in RGB order.
        profile: their colour space; one of tables leaves them alone.
    """
    if profile.decode is None or profile.matrix is None:
        return pixels
    top = np.iinfo(pixels.dtype).max
    levels = np.arange(top + 1) / top
    grid = np.linspace(0, 1, _ENTRIES)
    table = np.stack([np.interp(levels, grid, c) for c in profile.decode.T], 1).astype(np.float32)
    light = np.stack([table[pixels[..., c], c] for c in range(3)], -1)
    return encode_16(light @ profile.matrix.T.astype(np.float32))


def encode_16(light: Float[np.ndarray, "..."]) -> UInt[np.ndarray, "..."]:
    """Return light in [0, 1] as sRGB in 16 bits; what is outside is clipped."""
    return np.rint(srgb_encode(light) * 65535).astype(np.uint16)


def applied(data: bytes, pixels: UInt[np.ndarray, "h w c"]) -> UInt[np.ndarray, "h w c"]:
    """Return the colours of a photograph in sRGB.

    Args:
        data: of its file.
        pixels: as OpenCV decodes them: B G R, perhaps with alpha behind.
    """
    if pixels.ndim != 3 or pixels.shape[2] < 3 or pixels.dtype not in (np.uint8, np.uint16):
        return pixels
    try:
        with Image.open(io.BytesIO(data)) as image:
            profile = profile_of(image)
    except Exception:  # of what Pillow cannot open nothing is known
        return pixels
    if profile is None or profile.decode is None:
        return pixels
    colours = to_srgb(pixels[..., 2::-1], profile)[..., ::-1]
    if pixels.shape[2] == 3:
        return colours
    alpha = pixels[..., 3:].astype(np.uint16)
    return np.concatenate([colours, alpha * 257 if pixels.dtype == np.uint8 else alpha], axis=2)


def _is_srgb(profile: Profile) -> bool:
    assert profile.decode is not None
    assert profile.matrix is not None
    grid = np.linspace(0, 1, _ENTRIES)
    curves_alike = np.abs(srgb_encode(profile.decode) - grid[:, None]).max() < _INVISIBLE
    return bool(curves_alike and np.abs(profile.matrix - np.eye(3)).max() < _INVISIBLE)


def _tags(data: bytes) -> dict[bytes, bytes]:
    if data[36:40] != b"acsp":
        raise ValueError("not a profile")
    (count,) = struct.unpack(">I", data[128:132])
    rows = (struct.unpack(">4sII", data[132 + 12 * k : 144 + 12 * k]) for k in range(count))
    return {key: data[start : start + size] for key, start, size in rows}


def _text(tag: bytes) -> str:
    if tag[:4] == b"desc":
        (size,) = struct.unpack(">I", tag[8:12])
        return tag[12 : 12 + size].decode("latin-1").strip("\0 ")
    if tag[:4] == b"mluc":
        size, start = struct.unpack(">II", tag[20:28])
        return tag[start : start + size].decode("utf-16-be", "replace").strip("\0 ")
    return ""


def _xyz(tag: bytes) -> Float[np.ndarray, " 3"]:
    if tag[:4] != b"XYZ ":
        raise ValueError("not a colour")
    return np.array(struct.unpack(">3i", tag[8:20])) / 65536


def _curve(tag: bytes) -> Float[np.ndarray, " n"]:
    """Return the light of evenly spaced values."""
    x = np.linspace(0, 1, _ENTRIES)
    if tag[:4] == b"curv":
        (count,) = struct.unpack(">I", tag[8:12])
        if count == 0:
            return x
        values = np.array(struct.unpack(f">{count}H", tag[12 : 12 + 2 * count]), float)
        if count == 1:
            return x ** (values[0] / 256)
        return np.interp(x, np.linspace(0, 1, count), values / 65535)
    if tag[:4] != b"para":
        raise ValueError("not a curve")
    (kind,) = struct.unpack(">H", tag[8:10])
    count = (1, 3, 4, 5, 7)[kind]
    p = np.array(struct.unpack(f">{count}i", tag[12 : 12 + 4 * count])) / 65536
    if kind == 0:
        return x ** p[0]
    g, a, b = p[:3]
    # Below `start` a line, above it a power.
    slope, start = (0.0, -b / a) if kind <= 2 else p[3:5]
    lift = {1: 0.0, 2: p[-1], 3: 0.0, 4: p[-2]}[kind]
    foot = {1: 0.0, 2: p[-1], 3: 0.0, 4: p[-1]}[kind]
    return np.where(x >= start, np.maximum(a * x + b, 0) ** g + lift, slope * x + foot)
