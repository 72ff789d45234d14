"""Colours: transfer functions, primaries and ICC profiles, converted to light or to sRGB.

Sources: ITU-R BT.2100-2 (PQ and HLG, tables 4 and 5), BT.2020, IEC 61966-2-1, ICC.1:2022, and the
third edition of PNG (4.3, which chunk counts; 11.3.2, their contents). Only ICC profiles with a
matrix and a curve per channel are applied (ICC.1:2022, 8.3.3), as all cameras and phones write
them. Other profiles are ignored, and a note says so.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt
from PIL import Image, ImageCms

from p2gs_jax.core.numerics import srgb_decode, srgb_encode

Transfer = Literal["hlg", "pq"]

PQ_WHITE = 1000.0
"""Luminance that becomes 1, cd/m^2: the peak of phones and most masters. Above it, PQ saturates."""
_HLG_A = 0.17883277
_HLG_B, _HLG_C = 1 - 4 * _HLG_A, 0.5 - _HLG_A * np.log(4 * _HLG_A)
_M1, _M2 = 2610 / 16384, 2523 / 4096 * 128
_C1, _C2, _C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32

# Chromaticities of red, green, blue and white.
Primaries = tuple[float, float, float, float, float, float, float, float]
_D65 = (0.3127, 0.3290)
BT709: Primaries = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65)
BT2020: Primaries = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65)
DISPLAY_P3: Primaries = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65)
ADOBE_RGB: Primaries = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65)
# Codes of ITU-T H.273. With another code, the tone curve is unknown or the primaries are sRGB's.
TRANSFERS: dict[int, Transfer] = {16: "pq", 18: "hlg"}
PRIMARIES: dict[int, Primaries] = {9: BT2020, 12: DISPLAY_P3}

# Bradford's cone responses.
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
# The white point of the profile connection space, D50.
_PCS_WHITE = np.array([0.9642, 1.0, 0.8249])
# A profile that changes colours by less than this, display values, counts as sRGB.
_INVISIBLE = 0.004
# EXIF tags, and their mark of Adobe RGB in files without a profile (DCF).
_INTEROPERABILITY, _INTEROP_INDEX = 0xA005, 1
_DCF_OPTION = "R03"
_ENTRIES = 1024
_GRID = np.linspace(0, 1, _ENTRIES)[:, None]
_PNG_NAME = "the colour space of their PNG headers"
# The value in PNG's chunk gAMA that stands for sRGB's curve, which is nearly this power.
_PNG_SRGB = 0.45455


def to_light(signal: Float[np.ndarray, "..."], transfer: Transfer) -> Float[np.ndarray, "..."]:
    """Return light in [0, 1] of a coded signal in [0, 1], for red, green and blue alike.

    HLG gives the light of the scene, with 1 for the largest code; PQ gives the light of the
    reference display, with 1 for `PQ_WHITE`.
    """
    x = np.clip(signal, 0.0, 1.0)
    if transfer == "hlg":
        return np.where(x <= 0.5, x * x / 3, (np.exp((x - _HLG_C) / _HLG_A) + _HLG_B) / 12)
    root = x ** (1 / _M2)
    light = (np.maximum(root - _C1, 0) / (_C2 - _C3 * root)) ** (1 / _M1)
    return np.minimum(light * (10000 / PQ_WHITE), 1.0)


def rgb_to_xyz(primaries: Primaries) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear colours to XYZ, with Y = 1 for white."""
    xy = np.array(primaries).reshape(4, 2)
    columns = np.stack([xy[:, 0] / xy[:, 1], np.ones(4), (1 - xy.sum(1)) / xy[:, 1]])
    scale = np.linalg.solve(columns[:, :3], columns[:, 3])
    return columns[:, :3] * scale


def adapted(
    from_white: Float[np.ndarray, " 3"], to_white: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that adapts XYZ from one white point to another (Bradford)."""
    gain = (_BRADFORD @ to_white) / (_BRADFORD @ from_white)
    return np.linalg.inv(_BRADFORD) @ np.diag(gain) @ _BRADFORD


def to_srgb_matrix(primaries: Primaries) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear colours in these primaries to linear sRGB."""
    other, srgb = rgb_to_xyz(primaries), rgb_to_xyz(BT709)
    return np.linalg.inv(srgb) @ adapted(other.sum(1), srgb.sum(1)) @ other


@dataclass(frozen=True)
class Profile:
    """A colour space of photographs other than sRGB.

    `decode` is the light at `_ENTRIES` evenly spaced values from 0 to 1 for each channel, and
    `matrix` converts it to linear sRGB. Both are None for a profile made of tables.
    """

    name: str
    decode: Float[np.ndarray, "n 3"] | None = None
    matrix: Float[np.ndarray, "3 3"] | None = None


def profile_of(image: Image.Image) -> Profile | None:
    """Return the colour space in the header of a photograph; None: sRGB, grey or unknown.

    The file must be open, as it is before the first access to pixels or EXIF.
    """
    coded = _cicp(image) if image.format == "PNG" else b""
    data = image.info.get("icc_profile")
    if data and not coded:
        return read_profile(bytes(data))
    if image.format == "PNG":
        return _png_profile(image.info, coded)
    try:
        index = image.getexif().get_ifd(_INTEROPERABILITY).get(_INTEROP_INDEX)
    except Exception:  # malformed EXIF raises many kinds of errors
        return None
    return adobe_rgb() if str(index).strip("\0 ") == _DCF_OPTION else None


def adobe_rgb() -> Profile:
    """Return Adobe RGB (1998)."""
    curve = _GRID ** (563 / 256)
    matrix = np.linalg.inv(rgb_to_xyz(BT709)) @ rgb_to_xyz(ADOBE_RGB)
    return Profile("Adobe RGB (1998)", np.repeat(curve, 3, 1), matrix)


def read_profile(data: bytes) -> Profile | None:
    """Return the colour space that an ICC profile describes; None: sRGB, grey or broken."""
    try:
        header: Any = ImageCms.ImageCmsProfile(io.BytesIO(data)).profile
        if header.xcolor_space.strip() != "RGB":
            return None
        name, tags = header.profile_description or "unnamed", _tags(data)
        colorants = (header.red_colorant, header.green_colorant, header.blue_colorant)
        if None in colorants or not {b"rTRC", b"gTRC", b"bTRC"} <= tags.keys():
            return Profile(name)
        curves = [_curve(tags[key]) for key in (b"rTRC", b"gTRC", b"bTRC")]
    except (OSError, struct.error, ValueError, IndexError):
        return None
    srgb, columns = rgb_to_xyz(BT709), np.stack([xyz for xyz, _ in colorants], 1)
    matrix = np.linalg.inv(srgb) @ adapted(_PCS_WHITE, srgb.sum(1)) @ columns
    return _unless_srgb(name, np.stack(curves, 1), matrix)


def _unless_srgb(
    name: str, decode: Float[np.ndarray, "n 3"], matrix: Float[np.ndarray, "3 3"]
) -> Profile | None:
    curves_alike = np.abs(srgb_encode(decode) - _GRID).max() < _INVISIBLE
    is_srgb = curves_alike and np.abs(matrix - np.eye(3)).max() < _INVISIBLE
    return None if is_srgb else Profile(name, decode, matrix)


def _cicp(image: Any) -> bytes:
    """Return the chunk of a PNG that Pillow skips, which states codes of H.273, or nothing."""
    file = image.fp
    position = file.tell()
    file.seek(0)
    head = file.read(position).partition(b"IDAT")[0]
    file.seek(position)
    return head.partition(b"cICP")[2][:4]


def _png_profile(info: dict, coded: bytes) -> Profile | None:
    """Return the colour space in a PNG's chunk cICP, or in gAMA and cHRM if it has no sRGB."""
    curve, primaries = srgb_decode(_GRID), BT709
    if coded:
        primaries = PRIMARIES.get(coded[0], BT709)
        curve = to_light(_GRID, TRANSFERS[coded[1]]) if coded[1] in TRANSFERS else curve
    elif "srgb" not in info:
        gamma, white_first = info.get("gamma", 0), info.get("chromaticity", ())
        if gamma > 0 and abs(gamma / _PNG_SRGB - 1) > 0.02:
            curve = _GRID ** (1 / gamma)
        if len(white_first) == 8 and min(white_first[1::2]) > 0:
            primaries = (*white_first[2:], *white_first[:2])
    return _unless_srgb(_PNG_NAME, np.repeat(curve, 3, 1), to_srgb_matrix(primaries))


def to_srgb(pixels: UInt[np.ndarray, "h w 3"], profile: Profile) -> UInt[np.ndarray, "h w 3"]:
    """Return RGB colours as sRGB with 16 bits, or unchanged for a profile made of tables.

    Colours outside sRGB are clipped, as if the camera had written sRGB.
    """
    if profile.decode is None or profile.matrix is None:
        return pixels
    top = np.iinfo(pixels.dtype).max
    levels = np.arange(top + 1) / top
    table = np.stack([np.interp(levels, _GRID[:, 0], c) for c in profile.decode.T], 1)
    light = np.stack([table.astype(np.float32)[pixels[..., c], c] for c in range(3)], -1)
    return encode_16(light @ profile.matrix.T.astype(np.float32))


def coded_profile(code: int) -> Profile | None:
    """Return the colour space with these primaries (ITU-T H.273, table 2) and sRGB's curve.

    HEIC, AVIF and video store the code. None: sRGB's primaries, or an unknown code.
    """
    if code not in PRIMARIES:
        return None
    curve = srgb_decode(_GRID)
    return Profile("coded", np.repeat(curve, 3, 1), to_srgb_matrix(PRIMARIES[code]))


def encode_16(light: Float[np.ndarray, "..."]) -> UInt[np.ndarray, "..."]:
    """Return light in [0, 1] as sRGB with 16 bits; light outside is clipped."""
    return np.rint(srgb_encode(light) * 65535).astype(np.uint16)


def with_profile_applied(
    data: bytes, pixels: UInt[np.ndarray, "h w c"]
) -> UInt[np.ndarray, "h w c"]:
    """Return a photograph in sRGB; `data` is its file, which holds the profile.

    Pixels are in OpenCV's order B G R, or B G R A.
    """
    if pixels.ndim != 3 or pixels.shape[2] < 3 or pixels.dtype not in (np.uint8, np.uint16):
        return pixels
    try:
        with Image.open(io.BytesIO(data)) as image:
            profile = profile_of(image)
    except Exception:  # the profile of a file that Pillow cannot open is unknown
        return pixels
    if profile is None or profile.decode is None:
        return pixels
    order = [2, 1, 0, 3][: pixels.shape[2]]
    return brought_to_srgb(pixels[..., order], profile)[..., order]


def brought_to_srgb(
    pixels: UInt[np.ndarray, "h w c"], profile: Profile
) -> UInt[np.ndarray, "h w c"]:
    """Return pixels R G B (A) as sRGB with 16 bits (see `to_srgb`); alpha stays linear."""
    colours = to_srgb(pixels[..., :3], profile)
    alpha = pixels[..., 3:].astype(np.uint16)
    return np.concatenate([colours, alpha * 257 if pixels.dtype == np.uint8 else alpha], axis=2)


def _tags(data: bytes) -> dict[bytes, bytes]:
    (count,) = struct.unpack(">I", data[128:132])
    rows = (struct.unpack(">4sII", data[132 + 12 * k : 144 + 12 * k]) for k in range(count))
    return {key: data[start : start + size] for key, start, size in rows}


def _curve(tag: bytes) -> Float[np.ndarray, " n"]:
    """Return the light at `_ENTRIES` evenly spaced values from 0 to 1."""
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
    # The curve is a line below `start` and a power above.
    slope, start = (0.0, -b / a) if kind <= 2 else p[3:5]
    lift = {1: 0.0, 2: p[-1], 3: 0.0, 4: p[-2]}[kind]
    foot = {1: 0.0, 2: p[-1], 3: 0.0, 4: p[-1]}[kind]
    return np.where(x >= start, np.maximum(a * x + b, 0) ** g + lift, slope * x + foot)


def colour_notes(paths: Iterable[Path]) -> tuple[str, ...]:
    """Return notes on colour profiles; only headers are read."""
    found = Counter[tuple[str, bool]]()
    for path in paths:
        with contextlib.suppress(Exception), Image.open(path) as image:  # decoding reports errors
            if (profile := profile_of(image)) is not None:
                found[profile.name, profile.decode is None] += 1
    return tuple(
        f"{n} photographs have the colour profile {name}, made of tables, which is not applied: "
        "their colours count as sRGB."
        if tables
        else f"{n} photographs are in {name}; they are converted to sRGB."
        for (name, tables), n in found.items()
    )
