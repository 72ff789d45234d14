"""The shown view as a file: PNG with display values, EXR with linear radiance."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from p2gs_jax.formats.exr import write_exr
from p2gs_jax.formats.frames import write_png
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.viewer.picture_modes import RenderedFrame

# Fewest and most pixels across.
SAVED_WIDTHS = (16, 16384)


def saved_size(width: int, aspect: float) -> tuple[int, int]:
    """Return a size with square pixels.

    Args:
        width: pixels.
        aspect: width / height of the canvas.
    """
    return width, max(1, round(width / aspect))


def png_bytes(ldr: Float32[np.ndarray, "h w 3"]) -> bytes:
    """Return display values as a PNG file."""
    with tempfile.TemporaryDirectory(prefix="p2gs-view-") as folder:
        path = Path(folder) / "view.png"
        write_png(path, ldr)
        return path.read_bytes()


def exr_bytes(frame: RenderedFrame, transform: DisplayTransform) -> bytes:
    """Return a frame as an EXR file with depth, opacity, display transform and camera in it."""
    with tempfile.TemporaryDirectory(prefix="p2gs-view-") as folder:
        path = Path(folder) / "view.exr"
        write_exr(
            path,
            np.asarray(frame.linear),
            depth=frame.depth,
            alpha=frame.alpha,
            taken=transform,
            camera=frame.camera,
        )
        return path.read_bytes()
