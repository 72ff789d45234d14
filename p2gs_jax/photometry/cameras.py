"""What physical cameras do to light by their place: rows of cameras by name, and vignetting.

V of camera c darkens towards the corners: log V_c(r) = k1 r^2 + k2 r^4 + k3 r^6 with r = 1 in the
corners of the image (docs/photometry.md, 1). Positions are measured from the image's centre in
units of half its diagonal, so that they do not depend on the size of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.core.numerics import Values, namespace

# The row of a camera that is not in `PhotometryConfig.cameras`; tables end with a row for it.
UNKNOWN = -1


def camera_row(name: str, cfg: PhotometryConfig) -> int | None:
    """Return the row of a camera in `cfg.cameras`: -1 if it is not there, None if nothing is.

    Args:
        name: as in `View.camera`.
        cfg: the formation model.
    """
    if not cfg.cameras:
        return None
    rows = [i for i, camera in enumerate(cfg.cameras) if camera.name == name]
    return rows[0] if rows else UNKNOWN


def camera_rows(names: Sequence[str], cfg: PhotometryConfig) -> tuple[int, ...] | None:
    """Return the row of each camera in `cfg.cameras`; None if nothing is there."""
    if not cfg.cameras:
        return None
    return tuple(UNKNOWN if (row := camera_row(n, cfg)) is None else row for n in names)


def darkens(cfg: PhotometryConfig) -> bool:
    """Return whether any camera has vignetting."""
    return any(camera.vignetting for camera in cfg.cameras)


def vignetting_table(cfg: PhotometryConfig) -> Float[np.ndarray, "c k n"]:
    """Return the coefficients of all cameras and of an unknown one, which has none.

    There is one row (K = 1) for all channels, or one for each where any camera has that.
    """
    rows = max((len(camera.vignetting) for camera in cfg.cameras), default=1)
    terms = max((len(row) for c in cfg.cameras for row in c.vignetting), default=1)
    table = np.zeros((len(cfg.cameras) + 1, max(rows, 1), max(terms, 1)), np.float32)
    for place, camera in zip(table, cfg.cameras, strict=False):
        for channel in range(len(place)) if camera.vignetting else ():
            row = camera.vignetting[channel if len(camera.vignetting) > 1 else 0]
            place[channel, : len(row)] = row
    return table


def squared_radii(height: int, width: int, xp: Any = np) -> Float[np.ndarray, "h w"]:
    """Return r^2 of the pixels of an image: 0 in its centre, 1 in its corners.

    With JAX as `xp`, a compiled program holds a row and a column of them, not the image.
    """
    diagonal = (height**2 + width**2) / 4
    y, x = np.arange(height) + 0.5 - height / 2, np.arange(width) + 0.5 - width / 2
    column, row = (xp.asarray(v**2 / diagonal, np.float32) for v in (y, x))
    return column[:, None] + row


def places(xy: Values, width: int, height: int) -> Values:
    """Return positions from the image's centre in units of half its diagonal.

    Args:
        xy: pixels, centres at +0.5.
        width: of the image, pixels.
        height: likewise.
    """
    centre = np.array([width / 2, height / 2], np.float32)
    return (xy - centre) / np.float32(np.hypot(*centre))


def log_vignetting(
    squared: Values, camera: Int[Array, "..."] | int, cfg: PhotometryConfig
) -> Values:
    """Return log V, with an axis of one or three channels appended.

    Args:
        squared: r^2, of any shape.
        camera: row in `cfg.cameras`, or -1: one for all, or one each.
        cfg: the cameras.
    """
    xp = namespace(squared, camera)
    k = xp.asarray(vignetting_table(cfg))[camera]
    s = squared[..., None]
    value = xp.zeros_like(s)
    for term in reversed(range(k.shape[-1])):
        value = s * (value + k[..., term])
    return value


def corner(camera: CameraFormation) -> tuple[float, ...]:
    """Return V in the corners of a camera's image, one for every row of its vignetting."""
    return tuple(float(np.exp(np.sum(row))) for row in camera.vignetting)
