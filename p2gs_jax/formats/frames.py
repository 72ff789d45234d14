"""Output frames: rendered pictures as files in a folder, or as one video."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from p2gs_jax.formats.exr import write_exr
from p2gs_jax.formats.png import write_png
from p2gs_jax.formats.video import open_video
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.types import Camera


@dataclass(frozen=True)
class OutputFrame:
    """A rendered picture.

    Attributes:
        name: of its files, without suffix; may name subfolders.
        linear: radiance, without exposure.
        alpha: opacity.
        ldr: display values in [0, 1].
        transform: from `linear` to `ldr`.
        depth: alpha-weighted, or None.
        camera: the pinhole, or None for other images.
        photograph: taken from there, display values, or None.
    """

    name: str
    linear: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]
    ldr: Float32[np.ndarray, "h2 w2 3"]
    transform: DisplayTransform
    depth: Float32[np.ndarray, "h w"] | None = None
    camera: Camera | None = None
    photograph: Float32[np.ndarray, "h3 w3 3"] | None = None


WriteFrame = Callable[[OutputFrame], None]


def write_frame(folder: Path, frame: OutputFrame) -> None:
    """Write `NAME.exr` and `NAME.png`; beside a photograph, `NAME.render.png` and its own.

    Args:
        folder: it and the subfolders of the name are created.
        frame: the picture.
    """
    stem = folder / frame.name
    write_exr(
        stem.with_name(f"{stem.name}.exr"),
        frame.linear,
        depth=frame.depth,
        alpha=frame.alpha,
        taken=frame.transform,
        camera=frame.camera,
    )
    if frame.photograph is None:
        write_png(stem.with_name(f"{stem.name}.png"), frame.ldr)
    else:
        write_png(stem.with_name(f"{stem.name}.render.png"), frame.ldr)
        write_png(stem.with_name(f"{stem.name}.photograph.png"), frame.photograph)


@contextlib.contextmanager
def open_frames(out: Path, size: tuple[int, int], fps: float) -> Iterator[WriteFrame]:
    """Yield a function that takes frames in order: into a video, or into a folder.

    Args:
        out: a video where it ends with .mp4, otherwise a folder.
        size: (width, height) of the largest frame, pixels.
        fps: frames per second of a video.

    Raises:
        UserError: see `open_video`.
    """
    if out.suffix.lower() == ".mp4":
        with open_video(out, *size, fps) as add:
            yield lambda frame: add(frame.ldr)
    else:
        yield lambda frame: write_frame(out, frame)
