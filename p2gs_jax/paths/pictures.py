"""Pictures of a finished run: of shots, panoramas, and comparisons with photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import matplotlib
import numpy as np
from jaxtyping import Float32
from PIL import Image, ImageDraw, ImageFont

from p2gs_jax.formats.frames import OutputFrame, to_uint8
from p2gs_jax.paths.panorama import Cylinder, Layers, Wide, borders, render_wide, stitch
from p2gs_jax.paths.rig import Rig, TimeStep
from p2gs_jax.paths.shots import Poses, Shot
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.metering import ExposureOf, adapted, meter
from p2gs_jax.run.read import Run
from p2gs_jax.scene.drives.recording import short_name
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import inverse

# Pictures are metered at this width, pixels.
METERED_WIDTH = 240
# Display value where no camera sees anything.
NOTHING = 0.92
# Photographs are placed by the field's depth, smoothed over this part of the width, as noise of the
# depth would fray their edges.
SMOOTH = 1 / 80
# Colours of captions, and the font's size as a part of the width, at least so many pixels.
BACKGROUND, INK, FAINT = (255, 255, 255), (30, 30, 30), (120, 120, 120)
FONT, SMALLEST_FONT = 1 / 60, 11


class RunRenderer:
    """Renders and develops pictures of a run."""

    def __init__(self, run: Run):
        self.run = run

    def linear(self, shot: Shot) -> Layers:
        """Return linear radiance, alpha and alpha-weighted depth of a pinhole camera."""
        return self._layers(shot)

    def wide(self, cylinder: Cylinder, at: float | None = None) -> Wide:
        """Return a wide view of the field; what moves is where it was `at` seconds, if anywhere."""
        return render_wide(lambda shot: self._layers(replace(shot, time=at)), cylinder)

    def _layers(self, shot: Shot) -> Layers:
        result = self.run.render(shot.camera(), shot.time)
        return np.asarray(result.linear), np.asarray(result.alpha), np.asarray(result.depth)

    def develop(
        self,
        linear: Float32[np.ndarray, "h w 3"],
        transform: DisplayTransform,
        alpha: Float32[np.ndarray, "h w"],
    ):
        """Return display values, over the background if the transform has one."""
        return develop(linear, transform, alpha=alpha)


def metered_shots(
    renderer: RunRenderer,
    shots: Sequence[Shot],
    of: ExposureOf,
    exposure_ev: float = 0.0,
    frames: float = 0.0,
) -> list[Shot]:
    """Return shots with the exposures that a metering rule gives small pictures of them.

    `exposure_ev` adds stops. Exposures follow what is seen within about `frames` shots, in their
    order; 0 meters each by itself.
    """
    run = renderer.run
    stops = []
    for shot in shots:
        small = shot.resized(METERED_WIDTH) if shot.width > METERED_WIDTH else shot
        rendered = run.render(small.camera(), small.time)
        readings = meter(np.asarray(rendered.linear), np.asarray(rendered.alpha))
        stops.append(run.metering.exposure_ev(readings, of))
    if frames > 0:
        stops = adapted(np.array(stops), frames).tolist()
    added = exposure_ev - float(np.log2(run.mean.exposure_geometric))
    return [replace(shot, exposure_ev=ev + added) for shot, ev in zip(shots, stops, strict=True)]


def shot_frames(
    renderer: RunRenderer,
    shots: Sequence[Shot],
    display_of: Callable[[Shot], DisplayTransform],
    photograph: Callable[[int], Float32[np.ndarray, "h w 3"] | None] | None = None,
) -> Iterator[OutputFrame]:
    """Yield a frame for every shot; `photograph` returns what is written beside a view."""
    for shot in shots:
        linear, alpha, depth = renderer.linear(shot)
        transform = display_of(shot)
        ldr = renderer.develop(linear, transform, alpha)
        beside = None if photograph is None or shot.view is None else photograph(shot.view)
        yield OutputFrame(shot.name, linear, alpha, ldr, transform, depth, shot.camera(), beside)


def wide_frames(
    renderer: RunRenderer,
    cylinder: Cylinder,
    poses: Poses,
    transform: DisplayTransform,
    times: Sequence[float | None],
) -> Iterator[OutputFrame]:
    """Yield wide views of the field from rig-to-world poses.

    The viewmat of the cylinder is rig-to-camera. What moves is shown at the times, seconds, or not
    at all.
    """
    for k, (pose, at) in enumerate(zip(poses, times, strict=True)):
        wide = renderer.wide(_placed(cylinder, pose), at)
        ldr = renderer.develop(wide.linear, transform, wide.alpha)
        yield OutputFrame(f"{k:05d}", wide.linear, wide.alpha, ldr, transform)


def comparison_size(cylinder: Cylinder) -> tuple[int, int]:
    """Return (width, height) of the pictures of `comparison_frames`."""
    return stacked_size(cylinder.width, [cylinder.height] * 3, captions=1)


def comparison_frames(
    renderer: RunRenderer,
    rig: Rig,
    steps: Sequence[TimeStep],
    cylinder: Cylinder,
    transform: DisplayTransform,
    store: ImageStore,
) -> Iterator[OutputFrame]:
    """Yield three panoramas below each other for every time step.

    Photographs stitched as taken; the same, each taken back to radiance by all that its camera did
    and developed with one display transform; the field under the same. Photographs are placed by
    the field's smoothed depth, and nothing is blended. The frame's `linear` is the field. The
    viewmat of `cylinder` is rig-to-camera.
    """
    mean = renderer.run.mean.exposure_geometric
    for step in steps:
        placed = _placed(cylinder, step.pose)
        wide = renderer.wide(placed, step.time)
        names = [name for name in rig.mounts if name in step.shots]
        shots = [step.shots[name] for name in names]
        rows = [shot.view for shot in shots if shot.view is not None]
        transforms = [renderer.run.own_display(row) for row in rows]
        photographs, masks = zip(*(store.get(row) for row in rows), strict=True)
        radiance = [undevelop(p, own) for p, own in zip(photographs, transforms, strict=True)]
        near = cv2.GaussianBlur(wide.nearness, (0, 0), SMOOTH * cylinder.width)
        taken = stitch(photographs, shots, placed, near, masks)
        same = stitch(radiance, shots, placed, near, masks)
        seen = taken.source[..., None] >= 0
        stops = [float(np.log2(own.exposure / mean)) for own in transforms]
        captions = [
            (f"{short_name(names[k])} {stops[k]:+.1f} EV".replace("-", "−"), start, end)
            for k, start, end in borders(taken.source[cylinder.height // 2])
        ]
        alike = np.where(seen, develop(same.image, transform), NOTHING)
        field = renderer.develop(wide.linear, transform, wide.alpha)
        panels = [
            CaptionedImage("photographs as taken", np.where(seen, taken.image, NOTHING), captions),
            CaptionedImage("the same photographs, developed to one exposure", alike),
            CaptionedImage("the radiance field at that exposure", field),
        ]
        yield OutputFrame(step.name, wide.linear, wide.alpha, stacked(panels), transform)


def _placed(cylinder: Cylinder, pose) -> Cylinder:
    return replace(cylinder, viewmat=cylinder.viewmat @ inverse(pose))


class CaptionedImage(NamedTuple):
    """An image, display values, with a title above it.

    Captions are (text, first column, end column): written below those columns with a tick at each
    inner edge, and shortened where they are wider.
    """

    title: str
    image: Float32[np.ndarray, "h w 3"]
    captions: Sequence[tuple[str, int, int]] = ()


def _font(width: int) -> ImageFont.FreeTypeFont:
    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(path, max(SMALLEST_FONT, round(FONT * width)))


def _line(width: int) -> int:
    return round(1.7 * _font(width).size)


def _shortened(text: str, width: int, font: ImageFont.FreeTypeFont) -> str:
    """Return the text, or as much of its beginning as fits before an ellipsis."""
    shorter = [text, *(f"{text[:n]}…" for n in range(len(text) - 1, 0, -1))]
    return next((t for t in shorter if font.getlength(t) <= width), "")


def stacked_size(width: int, heights: Sequence[int], captions: int) -> tuple[int, int]:
    """Return (width, height) of `stacked` for rows of these heights, some of them with captions."""
    return width, sum(heights) + (len(heights) + captions) * _line(width)


def stacked(rows: Sequence[CaptionedImage]) -> Float32[np.ndarray, "h w 3"]:
    """Return images of one width below each other, as display values."""
    width = rows[0].image.shape[1]
    captions = sum(bool(row.captions) for row in rows)
    size = stacked_size(width, [row.image.shape[0] for row in rows], captions)
    font, line = _font(width), _line(width)
    sheet = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    top = 0
    for row in rows:
        draw.text((2, top + line / 2), row.title, INK, font, anchor="lm")
        codes = to_uint8(row.image)
        sheet.paste(Image.fromarray(codes), (0, top + line))
        top += line + codes.shape[0]
        for text, start, end in row.captions:
            if end < width:
                draw.line([(end, top), (end, top + line / 2)], INK, max(1, line // 16))
            place = ((start + end) / 2, top + line / 2)
            draw.text(place, _shortened(text, end - start, font), FAINT, font, anchor="mm")
        top += line if row.captions else 0
    return np.asarray(sheet, np.float32) / 255
