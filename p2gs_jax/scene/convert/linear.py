"""Files of linear light: camera raw, OpenEXR, and TIFF of floats.

LibRaw subtracts the black level of raw, makes white 1, interpolates the colour filter, and goes to
sRGB's primaries with the camera's matrix. A camera's automatic white balance differs between
photographs, but a sensor does not: all photographs of one camera model get the same factors.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from jaxtyping import Float32
from PIL import ExifTags, Image

from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.convert.icc import to_srgb_matrix
from p2gs_jax.scene.convert.kinds import Picture

Balance = tuple[float, float, float]

_TIME, _F_NUMBER, _ISO, _FOCAL_LENGTH = 0x829A, 0x829D, 0x8827, 0x920A
# LibRaw's attributes.
_RAW_SETTINGS = {"shutter_speed": _TIME, "aperture": _F_NUMBER, "iso_speed": _ISO}
_RAW_SETTINGS |= {"focal_length": _FOCAL_LENGTH}
# OpenEXR's standard attributes.
_EXR_SETTINGS = {"expTime": _TIME, "aperture": _F_NUMBER, "isoSpeed": _ISO}
_EXR_ERRORS = (RuntimeError, KeyError, OSError, ValueError)


@dataclass(frozen=True)
class RawFacts:
    """What a raw file states about itself; the size is pixels, as the sensor lies.

    `balance` are the factors on red, green (1) and blue that the camera chose, None where it is not
    recorded; `black` is subtracted, by colour of the filter, and `white` becomes 1. Without a
    `matrix` the camera's colours are unknown, and its primaries are kept.
    """

    size: tuple[int, int]
    camera: str
    balance: Balance | None
    black: tuple[float, ...]
    white: float
    matrix: bool


def read_facts(path: Path) -> RawFacts:
    """Return what a raw file states about itself; pixels are not read.

    Raises UserError: rawpy is not installed, or LibRaw does not know this file.
    """
    with _raw(path) as raw:
        chosen = [float(x) for x in raw.camera_whitebalance[:3]]
        exif = _raw_exif(path, raw)
        names = (str(exif.get(tag, "")).strip("\0 ") for tag in (0x010F, 0x0110))
        green = chosen[1]
        balance = (chosen[0] / green, 1.0, chosen[2] / green) if min(chosen) > 0 else None
        black = tuple(float(x) for x in raw.black_level_per_channel)
        matrix = bool(np.any(raw.color_matrix) or np.any(raw.rgb_xyz_matrix))
        size, camera = (raw.sizes.width, raw.sizes.height), " ".join(n for n in names if n)
        return RawFacts(size, camera, balance, black, float(raw.white_level), matrix)


def read_raw(path: Path, balance: Balance | None) -> Picture:
    """Return the light of a raw photograph, saturated at 1, unrotated.

    The factors on red, green and blue are `balance`, or LibRaw's for daylight. Raises UserError:
    rawpy is not installed, or LibRaw cannot decode this file.
    """
    with _raw(path) as raw:
        pixels = raw.postprocess(
            user_wb=None if balance is None else [*balance, balance[1]],
            gamma=(1, 1),
            no_auto_bright=True,
            # White would follow the brightest pixel of each photograph.
            adjust_maximum_thr=0.0,
            output_bps=16,
            user_flip=0,
        )
        light = pixels.astype(np.float32) / np.float32(65535)
        return Picture(light=light, exif=_raw_exif(path, raw))


def read_raw_exif(path: Path) -> Image.Exif:
    """Return how a raw photograph was taken; errors are as of `read_facts`."""
    with _raw(path) as raw:
        return _raw_exif(path, raw)


@contextmanager
def _raw(path: Path) -> Iterator[Any]:
    try:
        import rawpy
    except ImportError:
        why = f"{path} is camera raw, which is read with rawpy."
        fix = "pip install 'p2gs-jax[raw]', or export the photographs as 16-bit TIFF"
        raise UserError(why, fix=fix) from None
    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except rawpy.LibRawFileUnsupportedError:
        raise UserError(
            f"LibRaw {'.'.join(map(str, rawpy.libraw_version))} does not know {path}: it is of a "
            "newer camera, or not a raw file.",
            fix="pip install --upgrade rawpy, or convert it with Adobe's DNG Converter",
        ) from None
    except (rawpy.LibRawError, rawpy.NotSupportedError) as error:
        why = error.args[0] if error.args else error
        text = why.decode("latin-1") if isinstance(why, bytes) else str(why)
        fix = "copy that photograph again, or remove it from the scene"
        raise broken(path, f"cannot be decoded: {text}.", fix) from None


def _raw_exif(path: Path, raw: Any) -> Image.Exif:
    """Return EXIF: the file's where it is laid out as TIFF, completed by what LibRaw found."""
    out = Image.Exif()
    try:
        with path.open("rb") as file:
            if file.read(2) in (b"II", b"MM"):
                file.seek(0)
                out.load_from_fp(file)
                out.get_ifd(ExifTags.IFD.Exif)
    except Exception:  # malformed EXIF raises many kinds of errors
        out = Image.Exif()
    shot, other = out.get_ifd(ExifTags.IFD.Exif), getattr(raw, "other", None)
    for name, tag in _RAW_SETTINGS.items():
        value = getattr(other, name, None)
        if tag not in shot and value:
            shot[tag] = int(value) if tag == _ISO else float(value)
    return out


@contextmanager
def _exr(path: Path, **how: bool) -> Iterator[Any]:
    try:
        with OpenEXR.File(str(path), **how) as file:
            yield file
    except _EXR_ERRORS as error:
        fix = "copy or render it again, or remove it"
        raise broken(path, f"is not a readable OpenEXR file: {error}.", fix) from None


def exr_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of the data window; UserError: it is not a readable OpenEXR."""
    with _exr(path, header_only=True) as file:
        low, high = file.header()["dataWindow"]
    return int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)


def read_exr_exif(path: Path) -> Image.Exif | None:
    """Return how an OpenEXR was taken, from its standard attributes; errors as of `exr_size`."""
    with _exr(path, header_only=True) as file:
        return _exr_exif(dict(file.header()))


def read_exr(path: Path) -> Picture:
    """Return the light of an OpenEXR: channels R, G, B (of its only layer, too) or Y.

    Chromaticities in the header are converted. What is premultiplied by A is divided by it again.
    Raises UserError: the file is not a readable OpenEXR, or has no such channels.
    """
    with _exr(path, separate_channels=True) as file:
        channels: dict[str, Any] = {k: c.pixels for k, c in file.channels().items()}
        header = dict(file.header())
    layers = {k[: -len("R")] for k in channels if k == "R" or k.endswith(".R")}
    layer = "" if "" in layers else next(iter(sorted(layers)), None)
    if layer is not None and {layer + "G", layer + "B"} <= channels.keys():
        light = np.stack([channels[layer + c] for c in "RGB"], -1).astype(np.float32)
    elif "Y" in channels and "RY" not in channels:
        light, layer = np.repeat(channels["Y"].astype(np.float32)[..., None], 3, 2), ""
    else:
        why = f"has the channels {', '.join(sorted(channels))}."
        raise broken(path, why, "photographs need R, G and B, or Y")
    primaries = header.get("chromaticities")
    if primaries is not None and len(np.ravel(primaries)) == 8:
        matrix = to_srgb_matrix(tuple(np.ravel(primaries)))
        if np.abs(matrix - np.eye(3)).max() > 1e-3:
            light = light @ matrix.T.astype(np.float32)
    alpha = channels.get(f"{layer}A")
    if alpha is not None:
        alpha = np.clip(np.nan_to_num(alpha.astype(np.float32)), 0, 1)
        light = light / np.maximum(alpha, 1e-6)[..., None]
    return _counted(light, alpha, _exr_exif(header))


def read_float_tiff(path: Path) -> Picture:
    """Return the light of a TIFF of floats; UserError: it cannot be decoded."""
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if raw is None or raw.dtype not in (np.float32, np.float64):
        raise broken(path, "cannot be decoded.", "export it as 16-bit TIFF or as OpenEXR")
    raw = raw[..., None] if raw.ndim == 2 else raw
    alpha = raw[..., 3].astype(np.float32) if raw.shape[2] == 4 else None
    light = raw[..., [2, 1, 0]] if raw.shape[2] >= 3 else np.repeat(raw[..., :1], 3, 2)
    exif = Image.Exif()
    try:
        with path.open("rb") as file:
            exif.load_from_fp(file)
    except Exception:  # malformed EXIF raises many kinds of errors
        exif = None
    return _counted(light.astype(np.float32), alpha, exif)


def _counted(
    light: Float32[np.ndarray, "h w 3"],
    alpha: Float32[np.ndarray, "h w"] | None,
    exif: Image.Exif | None,
) -> Picture:
    # Infinite light is saturated; what is not a number is nothing.
    invalid = int(np.isnan(light).any(2).sum())
    light = np.nan_to_num(light, nan=0.0, posinf=float(np.finfo(np.float32).max), neginf=0.0)
    return Picture(light=light, alpha=alpha, exif=exif, invalid=invalid)


def _exr_exif(header: dict) -> Image.Exif | None:
    shot = {tag: float(header[key]) for key, tag in _EXR_SETTINGS.items() if header.get(key)}
    if not shot:
        return None
    if _ISO in shot:
        shot[_ISO] = int(shot[_ISO])
    out = Image.Exif()
    out.get_ifd(ExifTags.IFD.Exif).update(shot)
    return out
