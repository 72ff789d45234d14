"""Output frames: rendered pictures as PNG and EXR in a folder, or as one H.264 video."""

from __future__ import annotations

import base64
import contextlib
import html
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.formats.exr import write_exr
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.types import Camera

# Constant rate factor of videos; at 16 compression is hardly visible.
QUALITY = "16"
# Least width and height of a video after rounding, pixels.
SMALLEST = 16
# Suffixes of the files of a frame.
SUFFIXES = (".exr", ".png", ".render.png", ".photograph.png")


@dataclass(frozen=True)
class OutputFrame:
    """A rendered picture: radiance without exposure, opacity, and display values in [0, 1]."""

    name: str  # the path of its files in the output folder, without suffix
    linear: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]
    ldr: Float32[np.ndarray, "h2 w2 3"]
    transform: DisplayTransform  # converts `linear` to `ldr`
    depth: Float32[np.ndarray, "h w"] | None = None  # camera z times alpha, scene units
    camera: Camera | None = None
    photograph: Float32[np.ndarray, "h3 w3 3"] | None = None  # display values, at this pose


def to_uint8(ldr: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Return display values, clamped to [0, 1] and rounded to 8 bits; NaN becomes black."""
    return np.rint(np.clip(np.nan_to_num(ldr), 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, ldr: Float32[np.ndarray, "h w 3"]) -> None:
    """Write display values as 8 bits, NaN as black; OSError: the file cannot be written."""
    codes = to_uint8(ldr)
    with atomic_write(Path(path)) as temporary:
        if not cv2.imwrite(str(temporary), codes[..., ::-1]):
            raise OSError(f"{path} could not be written")


def remove_frame(folder: Path, name: str) -> None:
    """Remove the files that `write_frame` wrote for a frame of this name, if there are any."""
    for suffix in SUFFIXES:
        (folder / f"{name}{suffix}").unlink(missing_ok=True)


def write_frame(folder: Path, frame: OutputFrame) -> None:
    """Write NAME.exr, and NAME.png or, with a photograph, `.render.png` and `.photograph.png`."""
    stem = folder / frame.name
    write_exr(
        stem.with_name(f"{stem.name}.exr"),
        frame.linear,
        depth=frame.depth,
        alpha=frame.alpha,
        transform=frame.transform,
        camera=frame.camera,
    )
    if frame.photograph is None:
        write_png(stem.with_name(f"{stem.name}.png"), frame.ldr)
    else:
        write_png(stem.with_name(f"{stem.name}.render.png"), frame.ldr)
        write_png(stem.with_name(f"{stem.name}.photograph.png"), frame.photograph)


def data_url(kind: str, ldr: Float[np.ndarray, "h w 3"], quality: int | None = None) -> str:
    """Return display values as the data URL of a picture (png, jpeg, webp)."""
    flags = {"jpeg": cv2.IMWRITE_JPEG_QUALITY, "webp": cv2.IMWRITE_WEBP_QUALITY}
    options = [] if quality is None else [flags[kind], quality]
    done, data = cv2.imencode(f".{kind}", to_uint8(ldr)[..., ::-1], options)
    assert done
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"


def shrunk(image: Float[np.ndarray, "h w c"], longest: int) -> Float[np.ndarray, "h2 w2 c"]:
    """Return an image whose longer side has at most `longest` pixels."""
    share = longest / max(image.shape[:2])
    if share >= 1:
        return image
    return cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)


def notebook_html(rows: Mapping[str, object], picture: Path) -> str:
    """Return HTML for a notebook: a table of named values, and the picture file if it exists."""
    row = "<tr><th>{}</th><td>{}</td></tr>".format
    cells = [row(html.escape(name), html.escape(str(value))) for name, value in rows.items()]
    table, image = f"<table>{''.join(cells)}</table>", cv2.imread(str(picture))
    if image is None:
        return table
    return f'{table}<img src="{data_url("png", shrunk(image[..., ::-1] / 255, 900))}">'


@contextlib.contextmanager
def open_frames(
    out: Path, size: tuple[int, int], fps: float
) -> Iterator[Callable[[OutputFrame], None]]:
    """Yield a function that writes frames in order to a video (.mp4) or to a folder.

    `size` is (width, height) of the largest frame, pixels. Errors are as in `open_video`.
    """
    if out.suffix.lower() == ".mp4":
        with open_video(out, *size, fps) as add:
            yield lambda frame: add(frame.ldr)
    else:
        yield lambda frame: write_frame(out, frame)


@contextlib.contextmanager
def open_video(
    path: Path, width: int, height: int, fps: float
) -> Iterator[Callable[[Float32[np.ndarray, "h w 3"]], None]]:
    """Yield a function that appends display values in [0, 1]; the file appears at the end.

    `width` and `height`, pixels, are rounded down to even numbers, as the codec requires. Smaller
    frames are centred on black, larger ones are cut. Display values are tagged as BT.709 primaries
    with the sRGB curve. Raises UserError: the size is too small, or PyAV has no encoder.
    """
    # This import is late, because a fit writes pictures but no video.
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    size = (width // 2 * 2, height // 2 * 2)
    if min(size) < SMALLEST:
        fix = f"choose a larger --width, so that both are at least {SMALLEST}"
        raise UserError(f"{path}: {width}x{height} pixels are too few for a video.", fix=fix)
    if "libx264" not in av.codecs_available:
        fix = "install the wheel of `av` from PyPI, or write frames into a folder"
        raise UserError("This build of PyAV cannot encode H.264.", fix=fix)
    # The index comes first, so that browsers can play a file while it loads.
    options = {"movflags": "+faststart"}
    with (
        atomic_write(path) as temporary,
        av.open(str(temporary), "w", options=options) as container,
    ):
        rate = Fraction(fps).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": QUALITY})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        context = stream.codec_context
        context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
        context.color_primaries = ColorPrimaries.BT709
        context.color_trc = ColorTrc.IEC61966_2_1

        def add(ldr: Float32[np.ndarray, "h w 3"]) -> None:
            frame = av.VideoFrame.from_ndarray(_centred(to_uint8(ldr), size), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode(None))


def _centred(codes: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> np.ndarray:
    """Return a picture centred on black and cut to (width, height)."""
    width, height = size
    codes = codes[:height, :width]
    above, before = (height - codes.shape[0]) // 2, (width - codes.shape[1]) // 2
    out = np.zeros((height, width, 3), np.uint8)
    out[above : above + codes.shape[0], before : before + codes.shape[1]] = codes
    return out
