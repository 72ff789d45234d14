"""Files of linear light: OpenEXR, and TIFF of floats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from jaxtyping import Float32
from PIL import ExifTags, Image

from p2gs_jax.errors import UserError
from p2gs_jax.scene.photographs.light import to_srgb_matrix
from p2gs_jax.scene.photographs.picture import Picture

# Of standard attributes: exposure time, f-number, sensitivity.
_SETTINGS = {"expTime": 0x829A, "aperture": 0x829D, "isoSpeed": 0x8827}


def exr_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of the data window.

    Raises:
        UserError: the file is no readable OpenEXR.
    """
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
    except (RuntimeError, KeyError, OSError, ValueError) as error:
        raise _broken(path, error) from None
    return int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)


def read_exr(path: Path) -> Picture:
    """Return the light of an OpenEXR: channels R, G, B (of a layer, if there is but one) or Y.

    Chromaticities in the header are converted. What is premultiplied by A is divided by it again.

    Raises:
        UserError: the file is no readable OpenEXR, or has no such channels.
    """
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels: dict[str, Any] = {k: c.pixels for k, c in file.channels().items()}
            header = dict(file.header())
    except (RuntimeError, KeyError, OSError, ValueError) as error:
        raise _broken(path, error) from None
    layers = {k[: -len("R")] for k in channels if k == "R" or k.endswith(".R")}
    layer = "" if "" in layers else next(iter(sorted(layers)), None)
    if layer is not None and {layer + "G", layer + "B"} <= channels.keys():
        light = np.stack([channels[layer + c] for c in "RGB"], -1).astype(np.float32)
    elif "Y" in channels and "RY" not in channels:
        light, layer = np.repeat(channels["Y"].astype(np.float32)[..., None], 3, 2), ""
    else:
        raise UserError(
            f"{path} has the channels {', '.join(sorted(channels))}.",
            fix="photographs need R, G and B, or Y",
        )
    primaries = header.get("chromaticities")
    if primaries is not None and len(np.ravel(primaries)) == 8:
        matrix = to_srgb_matrix(tuple(np.ravel(primaries)))
        if np.abs(matrix - np.eye(3)).max() > 1e-3:
            light = light @ matrix.T.astype(np.float32)
    alpha = channels.get(f"{layer}A")
    if alpha is not None:
        alpha = np.clip(np.nan_to_num(alpha.astype(np.float32)), 0, 1)
        light = light / np.maximum(alpha, 1e-6)[..., None]
    return _counted(light, alpha, _exif_of(header))


def read_exr_exif(path: Path) -> Image.Exif | None:
    """Return how it was taken, of standard attributes, or None."""
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            return _exif_of(dict(file.header()))
    except (RuntimeError, OSError, ValueError):
        return None


def read_float_tiff(path: Path) -> Picture:
    """Return the light of a TIFF of floats.

    Raises:
        UserError: it cannot be decoded.
    """
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if raw is None or raw.dtype not in (np.float32, np.float64):
        raise UserError(f"{path} cannot be decoded.", fix="export it as 16-bit TIFF or as OpenEXR")
    raw = raw[..., None] if raw.ndim == 2 else raw
    alpha = raw[..., 3].astype(np.float32) if raw.shape[2] == 4 else None
    light = raw[..., [2, 1, 0]] if raw.shape[2] >= 3 else np.repeat(raw[..., :1], 3, 2)
    try:
        with path.open("rb") as file:
            exif = Image.Exif()
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
    broken = np.isnan(light).any(2)
    light = np.nan_to_num(light, nan=0.0, posinf=float(np.finfo(np.float32).max), neginf=0.0)
    return Picture(light=light, alpha=alpha, exif=exif, invalid=int(broken.sum()))


def _exif_of(header: dict) -> Image.Exif | None:
    shot = {tag: float(header[key]) for key, tag in _SETTINGS.items() if header.get(key)}
    if not shot:
        return None
    if 0x8827 in shot:
        shot[0x8827] = int(shot[0x8827])  # type: ignore[assignment]
    out = Image.Exif()
    out.get_ifd(ExifTags.IFD.Exif).update(shot)
    return out


def _broken(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} is no readable OpenEXR file: {error}.",
        fix="copy or render it again, or remove it",
    )
