"""EXIF, and readers for files that OpenCV cannot read: raw, HEIC, AVIF, WebP, OpenEXR.

LibRaw subtracts the black level of raw, scales white to 1, interpolates the colour filter, and
converts to sRGB's primaries with the camera's matrix. Automatic white balance differs between
photographs, but the sensor does not: photographs of one camera model share their balance. AVIF
and WebP are read through Pillow, always with 8 bits.
"""

from __future__ import annotations

import glob
import io
import math
import re
import struct
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
import OpenEXR
from jaxtyping import Float32, UInt
from PIL import ExifTags, Image

from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.convert import icc

Kind = Literal["plain", "raw", "heif", "avif", "webp", "exr"]
Balance = tuple[float, float, float]

_RAW = frozenset(
    {".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2"}
    | {".pef", ".srw", ".rwl", ".3fr", ".iiq", ".erf", ".mrw", ".x3f"}
)
_KINDS: dict[str, Kind] = {
    **dict.fromkeys(_RAW, "raw"),
    **dict.fromkeys((".heic", ".heif", ".hif"), "heif"),
    **{".avif": "avif", ".webp": "webp", ".exr": "exr"},
}
CONVERTED_SUFFIXES = frozenset(_KINDS)
"""Suffixes of files that must be converted."""
_TIME, _F_NUMBER, _ISO, _FOCAL_LENGTH, _DATE = 0x829A, 0x829D, 0x8827, 0x920A, 0x9003
# Focal length, that of the field of view on 35 mm film, and digital zoom.
_ZOOM = (_FOCAL_LENGTH, 0xA405, 0xA404)
# _ISO has 16 bits: 65535 means that another of these tags holds the value.
_SENSITIVITIES = (_ISO, 0x8833, 0x8832, 0x8831)
# APEX values (log2, stops) from this size on are broken.
_SHUTTER_SPEED, _APERTURE, _LARGEST_APEX = 0x9201, 0x9202, 32.0
_MAKE, _MODEL, _SERIAL, _LENS = 0x010F, 0x0110, 0xA431, 0xA434
INFINITE = np.finfo(np.float32).max  # stands for infinite light
# Last parts of the names of layers that hold the picture in OpenEXR; without a layer it is "".
_PICTURES = ("", "combined", "beauty", "rgba")
# Attributes of LibRaw.
_RAW_SETTINGS = {"shutter_speed": _TIME, "aperture": _F_NUMBER, "iso_speed": _ISO}
_RAW_SETTINGS |= {"focal_length": _FOCAL_LENGTH}
# Canon's CR3 holds the settings in its first bytes, this many at most.
_RAW_HEADER = 2**18
_AGAIN = "copy that photograph again, or remove it from the scene"


@dataclass(frozen=True)
class Picture:
    """A decoded photograph: display values (`codes`, `profile`) or light."""

    # The largest unsigned integer stands for 1; channels are R G B (A) or one.
    codes: UInt[np.ndarray, "h w c"] | None = None
    light: Float32[np.ndarray, "h w 3"] | None = None  # linear in sRGB's primaries
    alpha: Float32[np.ndarray, "h w"] | None = None  # in [0, 1]
    exif: Image.Exif | None = None
    profile: bytes | None = None
    invalid: int = 0  # number of pixels with NaN, stored as 0


def kind_of(path: Path) -> Kind:
    """Return the kind of a photograph from its suffix."""
    return _KINDS.get(path.suffix.lower(), "plain")


def pillow_heif(path: Path) -> Any:
    """Return the library that reads HEIC, registered with Pillow; UserError: it is absent."""
    try:
        import pillow_heif
    except ImportError:
        why = f"{path} is HEIC, which is read with pillow-heif."
        fix = "pip install 'p2gs-jax[heic]', or export the photographs as JPEG"
        raise UserError(why, fix=fix) from None
    pillow_heif.register_heif_opener()
    return pillow_heif


def read_heif(path: Path) -> Picture:
    """Return display values of a HEIC, AVIF or WebP, or its light if it is coded in HLG or PQ.

    Raises UserError: the library is missing, or the file is broken.
    """
    try:
        heif = pillow_heif(path) if kind_of(path) == "heif" else None
        # Some programs give a JPEG this suffix.
        if heif is not None and heif.is_supported(path):
            # Pillow's opener does not support 16 bits.
            image = heif.open_heif(path, convert_hdr_to_8bit=False)
            pixels = np.asarray(image)
        else:
            with Image.open(path) as image:
                mode = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}[len(image.getbands())]
                pixels = np.asarray(image.convert(mode))
        info = dict(image.info)
    except UserError:
        raise
    except Exception as error:  # decoding is lazy, and the libraries raise errors of many kinds
        raise broken(path, f"cannot be decoded: {str(error).strip().rstrip('.')}", _AGAIN) from None
    exif = Image.Exif()
    try:
        exif.load(info.get("exif") or b"")
    except Exception:  # malformed EXIF raises many kinds of errors
        exif = None
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.dtype == np.uint16:
        # Codes of 10 and 12 bits come shifted: the largest one must become white.
        white = pixels.max(initial=0) | (2**16 - 2 ** (16 - int(info.get("bit_depth", 16))))
        pixels = np.rint(pixels * (65535 / white)).astype(np.uint16)
    # The colour box holds the primaries (ITU-T H.273; 0: unknown) and the transfer function.
    if nclx := info.get("nclx_profile"):
        names = ("color_primaries", "transfer_characteristics")
        coded, code = (int(nclx.get(name, 0)) for name in names)
    else:  # Pillow does not report the box
        _, found, data = path.read_bytes().partition(b"colrnclx")
        coded, code = struct.unpack(">HH", data[:4].ljust(4, b"\0")) if found else (0, 0)
    transfer = icc.TRANSFERS.get(code)
    if transfer is None:
        profile = info.get("icc_profile")
        coded_space = None if profile or pixels.shape[2] < 3 else icc.coded_profile(coded)
        codes = pixels if coded_space is None else icc.brought_to_srgb(pixels, coded_space)
        return Picture(codes=codes, exif=exif, profile=profile)
    light = icc.to_light(pixels[..., :3] / np.iinfo(pixels.dtype).max, transfer)
    primaries = icc.PRIMARIES.get(coded, icc.BT709)
    light = np.broadcast_to(light, (*light.shape[:2], 3)) @ icc.to_srgb_matrix(primaries).T
    return Picture(light=light.astype(np.float32), exif=exif)


@dataclass(frozen=True)
class RawFacts:
    """The metadata of a raw file."""

    size: tuple[int, int]  # pixels, in the orientation of the sensor
    camera: str
    balance: Balance | None  # the camera's factors on red, green (1) and blue, if recorded
    matrix: bool  # False: LibRaw does not know the camera's colours, and pixels keep its primaries


def read_facts(path: Path) -> RawFacts:
    """Return the metadata of a raw file without reading pixels.

    Raises UserError: rawpy is not installed, or LibRaw cannot read this file.
    """
    with _raw(path) as raw:
        chosen = [float(x) for x in raw.camera_whitebalance[:3]]
        exif = _raw_exif(path, raw)
        names = [str(exif.get(tag, "")).strip("\0 ") for tag in (_MAKE, _MODEL)]
        green = chosen[1]
        balance = (chosen[0] / green, 1.0, chosen[2] / green) if min(chosen) > 0 else None
        matrix = bool(np.any(raw.color_matrix) or np.any(raw.rgb_xyz_matrix))
        size = (raw.sizes.width, raw.sizes.height)
        # A camera without a name gets one from its size and LibRaw's matrix for its model.
        known = zlib.crc32(np.asarray(raw.rgb_xyz_matrix).tobytes())
        unnamed = f"unnamed camera {known:08x} of {size[0]}x{size[1]} pixels"
        return RawFacts(size, " ".join(n for n in names if n) or unnamed, balance, matrix)


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
            # Other values make white depend on the brightest pixel of a photograph.
            adjust_maximum_thr=0.0,
            output_bps=16,
            user_flip=0,
        )
        light = pixels.astype(np.float32) / np.float32(65535)
        return Picture(light=light, exif=_raw_exif(path, raw))


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
        why = f"LibRaw {'.'.join(map(str, rawpy.libraw_version))} does not support {path}: the "
        why += "camera is newer, or this is not a raw file."
        fix = "pip install --upgrade rawpy, or convert it with Adobe's DNG Converter"
        raise UserError(why, fix=fix) from None
    except (rawpy.LibRawError, rawpy.NotSupportedError) as error:
        why = error.args[0] if error.args else error
        text = why.decode("latin-1") if isinstance(why, bytes) else str(why)
        raise broken(path, f"cannot be decoded: {text}.", _AGAIN) from None


def _raw_exif(path: Path, raw: Any) -> Image.Exif:
    """Return the file's EXIF if it can be read, completed by LibRaw's metadata."""
    out = Image.Exif()
    try:
        with path.open("rb") as file:
            out = exif_of_raw(file)
            out.get_ifd(ExifTags.IFD.Exif)
    except Exception:  # malformed EXIF raises many kinds of errors
        out = Image.Exif()
    shot, other = out.get_ifd(ExifTags.IFD.Exif), getattr(raw, "other", None)
    for name, tag in _RAW_SETTINGS.items():
        value = getattr(other, name, None)
        if tag not in shot and value:
            shot[tag] = int(value) if tag == _ISO else float(value)
    return out


def exif_of_raw(file: BinaryIO) -> Image.Exif:
    """Return the EXIF in a raw file: TIFF and its variants, Canon's CR3 and Fujifilm's RAF."""
    out, head = Image.Exif(), file.read(_RAW_HEADER)
    file.seek(0)
    if head[:4] in (b"II*\0", b"MM\0*"):
        out.load_from_fp(file)
    elif head[:2] in (b"II", b"MM"):
        # Olympus and Panasonic replace TIFF's number 42.
        mark = b"*\0" if head[:2] == b"II" else b"\0*"
        out.load_from_fp(io.BytesIO(head[:2] + mark + file.read()[4:]))
    elif head.startswith(b"FUJIFILMCCD-RAW"):
        # Byte 84 holds the position of a JPEG of the photograph.
        with Image.open(io.BytesIO(file.read()[int.from_bytes(head[84:88]) :])) as image:
            out = image.getexif()
            out.get_ifd(ExifTags.IFD.Exif)
    elif head[4:8] == b"ftyp" and b"CMT1" in head:
        # Two TIFF blocks hold the tags of the file and of the photograph.
        for name, target in ((b"CMT1", out), (b"CMT2", out.get_ifd(ExifTags.IFD.Exif))):
            part = Image.Exif()
            part.load(b"Exif\0\0" + head[head.index(name) + 4 :])
            target.update(dict(part))
    return out


@contextmanager
def _exr(path: Path, **how: bool) -> Iterator[Any]:
    try:
        with OpenEXR.File(str(path), **how) as file:
            yield file
    except (RuntimeError, KeyError, OSError, ValueError) as error:
        fix = "copy or render it again, or remove it"
        raise broken(path, f"is not a readable OpenEXR file: {error}.", fix) from None


def read_exr(path: Path) -> Picture:
    """Return the light of an OpenEXR: channels R, G, B (even in a layer) or Y.

    Colours are converted from the header's chromaticities, and divided by their alpha (A). Raises
    UserError: the file is not a readable OpenEXR; it has no such channels, or several layers of
    them, of which not exactly one has a name in `_PICTURES`; or it has a crop or overscan.
    """
    with _exr(path, separate_channels=True) as file:
        channels: dict[str, Any] = {k: c.pixels for k, c in file.channels().items()}
        header = dict(file.header())
    _exr_size(path, header)
    layers = sorted(k[: -len("R")] for k in channels if k == "R" or k.endswith(".R"))
    pictures = [k for k in layers if k.rpartition(".")[0].rpartition(".")[2].lower() in _PICTURES]
    if len(layers) > 1 and len(pictures) != 1:
        why = f"has the layers {', '.join(k.strip('.') or '(unnamed)' for k in layers)}."
        raise broken(path, why, "save it with one layer, that of the picture")
    layer = next(iter(pictures or layers), None)
    if layer is not None and {layer + "G", layer + "B"} <= channels.keys():
        light = np.stack([channels[layer + c] for c in "RGB"], -1).astype(np.float32)
    elif "Y" in channels and "RY" not in channels:
        light, layer = np.repeat(channels["Y"].astype(np.float32)[..., None], 3, 2), ""
    else:
        why = f"has the channels {', '.join(sorted(channels))}."
        raise broken(path, why, "photographs need R, G and B, or Y")
    # Infinite light is saturated; NaN is black.
    invalid, saturated = int(np.isnan(light).any(2).sum()), np.isposinf(light).any(2)
    light = np.nan_to_num(light, nan=0.0, posinf=0.0, neginf=0.0)
    primaries = header.get("chromaticities")
    if primaries is not None and len(np.ravel(primaries)) == 8:
        matrix = icc.to_srgb_matrix(tuple(np.ravel(primaries)))
        if np.abs(matrix - np.eye(3)).max() > 1e-3:
            light = light @ matrix.T.astype(np.float32)
    alpha = channels.get(f"{layer}A")
    if alpha is not None:
        alpha = np.clip(np.nan_to_num(alpha.astype(np.float32)), 0, 1)
        # Light without opacity, as of a glow, belongs to no surface.
        light = light / np.where(alpha > 1e-6, alpha, np.float32(np.inf))[..., None]
    light[saturated] = INFINITE
    return Picture(light=light, alpha=alpha, exif=_exr_exif(header), invalid=invalid)


def _exr_exif(header: dict) -> Image.Exif | None:
    names = ("expTime", "aperture", "isoSpeed")  # OpenEXR's standard attributes
    time, aperture, iso = (_positive(header.get(name)) for name in names)
    return made_exif(ExifSettings(time, aperture, iso))


def made_exif(settings: ExifSettings) -> Image.Exif | None:
    """Return EXIF with time, f-number and ISO, or None if all are unknown."""
    named = {_TIME: settings.time, _F_NUMBER: settings.aperture, _ISO: settings.iso}
    shot = {tag: value for tag, value in named.items() if value is not None}
    if not shot:
        return None
    if _ISO in shot:
        shot[_ISO] = int(shot[_ISO])
    out = Image.Exif()
    out.get_ifd(ExifTags.IFD.Exif).update(shot)
    return out


def size_of(path: Path) -> tuple[int, int] | None:
    """Return (width, height) of raw and OpenEXR, pixels; None: Pillow opens the file.

    Raises UserError: the file is broken, or a package for it is missing.
    """
    kind = kind_of(path)
    if kind == "heif":
        pillow_heif(path)
    if kind == "raw":
        return read_facts(path).size
    if kind == "exr":
        with _exr(path, header_only=True) as file:
            return _exr_size(path, dict(file.header()))
    return None


def _exr_size(path: Path, header: dict) -> tuple[int, int]:
    """Return width and height; UserError: the file has a crop or overscan."""
    sizes = {}
    for name in ("dataWindow", "displayWindow"):
        low, high = header[name]
        sizes[name] = (int(high[0] - low[0] + 1), int(high[1] - low[1] + 1), *map(int, low))
    data, frame = sizes["dataWindow"], sizes["displayWindow"]
    if data != frame:
        why = f"has {data[0]}x{data[1]} pixels at {data[2:]} in a frame of {frame[0]}x{frame[1]}, "
        why += "and intrinsics belong to the frame."
        raise broken(path, why, "save it without a crop or overscan")
    if (ratio := header.get("pixelAspectRatio", 1)) != 1:
        raise broken(path, f"has pixels with the aspect ratio {ratio:g}", "resample it to 1")
    return data[:2]


@dataclass(frozen=True)
class ExifSettings:
    """Exposure time (seconds), f-number, ISO, local date `YYYY:MM:DD HH:MM:SS`; None: unknown."""

    time: float | None = None
    aperture: float | None = None
    iso: float | None = None
    date: str | None = None


def read_exif_settings(path: Path) -> ExifSettings:
    """Return the settings in the EXIF of an image; without readable EXIF all are None.

    A missing time or f-number comes from APEX values, log2(1 / time) and log2(f-number^2).
    """
    tags = _exif_tags(path)
    time, aperture = _positive(tags.get(_TIME)), _positive(tags.get(_F_NUMBER))
    shutter, opening = _finite(tags.get(_SHUTTER_SPEED)), _positive(tags.get(_APERTURE))
    if time is None and shutter is not None and abs(shutter) < _LARGEST_APEX:
        time = 2.0**-shutter
    if aperture is None and opening is not None and opening < _LARGEST_APEX:
        aperture = 2.0 ** (opening / 2)
    isos = (_positive(tags.get(tag)) for tag in _SENSITIVITIES)
    date = str(tags.get(_DATE, "")).strip("\0 ")
    return ExifSettings(
        time=time,
        aperture=aperture,
        iso=next((value for value in isos if value not in (None, 65535.0)), None),
        date=date if re.fullmatch(r"\d{4}:\d\d:\d\d \d\d:\d\d:\d\d", date) else None,
    )


def exif_evs(paths: Sequence[Path], cameras: Sequence[str] = ()) -> list[float | None]:
    """Return log2(time * ISO / N^2) of photographs, stops; None: unknown.

    N is the f-number; only differences matter. A setting that no photograph states is a constant
    (ISO 100). A missing setting gets the value on which the camera's other photographs agree, if
    they do. Exposure bias is ignored: the time contains it. Files in `images_2` get the EXIF of
    `images`.
    """
    shots = [read_exif_settings(path) for path in map(_original, paths)]
    camera = np.array(list(cameras) or [""] * len(shots))
    total = np.zeros(len(shots))
    for name, power, usual in (("time", 1, 1.0), ("iso", 1, 100.0), ("aperture", -2, 1.0)):
        stated = np.array([getattr(shot, name) or np.nan for shot in shots], float)
        term, known = power * np.log2(stated), np.isfinite(stated)
        if not known.any():
            term[:] = power * np.log2(usual)
        for rows in (camera == one for one in np.unique(camera)):
            if (rows & known).any() and np.ptp(term[rows & known]) < 1e-6:
                term[rows] = term[rows & known][0]
        total += term
    total[[shot.time is None and shot.iso is None for shot in shots]] = np.nan
    return [float(ev) if np.isfinite(ev) else None for ev in total]


def _original(path: Path) -> Path:
    """Return the original of a smaller copy: the folder `images` beside `images_2`."""
    for folder in path.parents:
        full_size = folder.parent / "images"
        if folder.name.startswith("images_") and full_size.is_dir():
            original = full_size / path.relative_to(folder)
            if original.is_file():
                return original
            # Sidecars such as a.json may lie beside photographs.
            pictures = CONVERTED_SUFFIXES | Image.registered_extensions().keys()
            others = sorted(original.parent.glob(glob.escape(original.stem) + ".*"))
            return next((p for p in others if p.suffix.lower() in pictures), path)
    return path


def read_exif_camera(path: Path, *, zoom: bool = False) -> str:
    """Return make, model, serial number and lens as one string; empty without EXIF.

    With `zoom`, optical and digital zoom are added. EXIF after the pixels of a PNG is not read.
    """
    tags = _exif_tags(path, after_pixels=False)
    wanted = (_MAKE, _MODEL, _SERIAL, _LENS, *(_ZOOM if zoom else ()))
    parts = (tags.get(tag) for tag in wanted)
    return " ".join(str(part).strip("\0 ") for part in parts if part is not None)


def _exif_tags(path: Path, *, after_pixels: bool = True) -> dict:
    kind = kind_of(path)
    # Pillow raises many kinds of errors on malformed EXIF (struct, Syntax, Value, OS, ...).
    try:
        if kind == "raw":
            with _raw(path) as raw:
                return _flat(_raw_exif(path, raw))
        if kind == "exr":
            with _exr(path, header_only=True) as file:
                exif = _exr_exif(dict(file.header()))
            # The length of an Exif with settings alone is 0: test for None.
            return {} if exif is None else _flat(exif)
        if kind == "heif":
            pillow_heif(path)
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            # Pillow would decode a PNG to find EXIF after its pixels.
            if not after_pixels and image.format == "PNG" and "exif" not in image.info:
                return {}
            return _flat(image.getexif())
    except Exception:
        return {}


def _flat(exif: Image.Exif) -> dict:
    return {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}


def _finite(value: object) -> float | None:
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: object) -> float | None:
    number = _finite(value)
    return number if number is not None and number > 0 else None
