"""Pictures of a finished run: of shots, panoramas, and comparisons with photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from jaxtyping import Float32
from PIL import Image, ImageDraw, ImageFont

from p2gs_jax.formats.frames import OutputFrame, to_uint8
from p2gs_jax.paths.panorama import Cylinder, Layers, Wide, render_wide, stitch
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
# Colour of titles, and the font's size as a part of the width, at least so many pixels.
INK, FONT, SMALLEST_FONT = (30, 30, 30), 1 / 60, 11


def _layers(run: Run, shot: Shot) -> Layers:
    """Return linear radiance, alpha and alpha-weighted depth of a pinhole camera."""
    result = run.render(shot.camera(), shot.time)
    return np.asarray(result.linear), np.asarray(result.alpha), np.asarray(result.depth)


def _wide(run: Run, cylinder: Cylinder, at: float | None) -> Wide:
    """Return a wide view of the field; what moves is where it was `at` seconds, if anywhere."""
    return render_wide(lambda shot: _layers(run, replace(shot, time=at)), cylinder)


def metered_shots(
    run: Run,
    shots: Sequence[Shot],
    of: ExposureOf,
    exposure_ev: float = 0.0,
    frames: float = 0.0,
) -> list[Shot]:
    """Return shots with the exposures that a metering rule gives small pictures of them.

    `exposure_ev` adds stops. Exposures follow what is seen within about `frames` shots, in their
    order; 0 meters each by itself.
    """
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
    run: Run,
    shots: Sequence[Shot],
    display_of: Callable[[Shot], DisplayTransform],
    photograph: Callable[[int], Float32[np.ndarray, "h w 3"] | None] | None = None,
) -> Iterator[OutputFrame]:
    """Yield a frame for every shot; `photograph` returns what is written beside a view."""
    for shot in shots:
        linear, alpha, depth = _layers(run, shot)
        transform = display_of(shot)
        ldr = develop(linear, transform, alpha=alpha)
        beside = None if photograph is None or shot.view is None else photograph(shot.view)
        yield OutputFrame(shot.name, linear, alpha, ldr, transform, depth, shot.camera(), beside)


def wide_frames(
    run: Run,
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
        wide = _wide(run, _placed(cylinder, pose), at)
        ldr = develop(wide.linear, transform, alpha=wide.alpha)
        yield OutputFrame(f"{k:05d}", wide.linear, wide.alpha, ldr, transform)


def comparison_size(cylinder: Cylinder) -> tuple[int, int]:
    """Return (width, height) of the pictures of `comparison_frames`."""
    return cylinder.width, 3 * (cylinder.height + _font(cylinder.width)[1])


def comparison_frames(
    run: Run,
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
    mean = run.mean.exposure_geometric
    for step in steps:
        placed = _placed(cylinder, step.pose)
        wide = _wide(run, placed, step.time)
        names = [name for name in rig.mounts if name in step.shots]
        shots = [step.shots[name] for name in names]
        rows = [shot.view for shot in shots if shot.view is not None]
        transforms = [run.own_display(row) for row in rows]
        photographs, masks = zip(*(store.get(row) for row in rows), strict=True)
        radiance = [undevelop(p, own) for p, own in zip(photographs, transforms, strict=True)]
        near = cv2.GaussianBlur(wide.nearness, (0, 0), SMOOTH * cylinder.width)
        taken = stitch(photographs, shots, placed, near, masks)
        same = stitch(radiance, shots, placed, near, masks)
        seen = taken.source[..., None] >= 0
        stops = [float(np.log2(own.exposure / mean)) for own in transforms]
        middle = taken.source[cylinder.height // 2]
        order = dict.fromkeys(middle[middle >= 0].tolist())
        cameras = (f"{short_name(names[k])} {stops[k]:+.1f} EV".replace("-", "−") for k in order)
        alike = np.where(seen, develop(same.image, transform), NOTHING)
        field = develop(wide.linear, transform, alpha=wide.alpha)
        panels = [
            (f"as taken: {', '.join(cameras)}", np.where(seen, taken.image, NOTHING)),
            ("the same photographs, developed to one exposure", alike),
            ("the radiance field at that exposure", field),
        ]
        yield OutputFrame(step.name, wide.linear, wide.alpha, titled(panels), transform)


def _placed(cylinder: Cylinder, pose) -> Cylinder:
    return replace(cylinder, viewmat=cylinder.viewmat @ inverse(pose))


def _font(width: int) -> tuple[ImageFont.FreeTypeFont, int]:
    """Return the font of titles above images of a width, and the height of their line, pixels."""
    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    font = ImageFont.truetype(path, max(SMALLEST_FONT, round(FONT * width)))
    return font, round(1.7 * font.size)


def titled(
    rows: Sequence[tuple[str, Float32[np.ndarray, "h w 3"]]],
) -> Float32[np.ndarray, "h w 3"]:
    """Return images of one width below each other, as display values, each under its title."""
    width = rows[0][1].shape[1]
    font, line = _font(width)
    parts = []
    for title, image in rows:
        head = Image.new("RGB", (width, line), "white")
        ImageDraw.Draw(head).text((2, line / 2), title, INK, font, anchor="lm")
        parts += [np.asarray(head), to_uint8(image)]
    return np.concatenate(parts).astype(np.float32) / 255
