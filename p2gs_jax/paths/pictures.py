"""Pictures of a finished run: of shots, panoramas, and comparisons with photographs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32

from p2gs_jax.core.numerics import LN2
from p2gs_jax.formats.frames import OutputFrame
from p2gs_jax.paths import Cylinder
from p2gs_jax.paths.captioned_images import CaptionedImage, stacked, stacked_size
from p2gs_jax.paths.cylinder import borders
from p2gs_jax.paths.geometry import Poses
from p2gs_jax.paths.panorama import Layers, Wide, render_wide, stitch
from p2gs_jax.paths.rig import Rig, TimeStep
from p2gs_jax.paths.shots import Shot
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.metering import ExposureOf, adapted, meter
from p2gs_jax.run.read import Run
from p2gs_jax.scene.drives.choose import short_name
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import inverse

# Pictures are metered at this width, pixels.
METERED_WIDTH = 240
# Display value where no camera sees anything.
NOTHING = 0.92
# Photographs are placed by the field's depth, smoothed over this part of the width, as noise of the
# depth would fray their edges.
SMOOTH = 1 / 80


class RunRenderer:
    """Renders and develops pictures of a run, and measures the time of both.

    Attributes:
        run: the run.
        render_seconds: of every rendered picture.
        develop_seconds: of every developed picture.
    """

    def __init__(self, run: Run):
        self.run = run
        self.render_seconds: list[float] = []
        self.develop_seconds: list[float] = []

    def linear(self, shot: Shot) -> Layers:
        """Return linear radiance, alpha and alpha-weighted depth of a pinhole camera."""
        begin = time.perf_counter()
        layers = self._layers(shot)
        self.render_seconds.append(time.perf_counter() - begin)
        return layers

    def wide(self, cylinder: Cylinder, at: float | None = None) -> Wide:
        """Return a wide view of the field.

        Args:
            cylinder: the view.
            at: seconds: what moves is where it was then; None: it is not shown.
        """
        begin = time.perf_counter()
        wide = render_wide(lambda shot: self._layers(replace(shot, time=at)), cylinder)
        self.render_seconds.append(time.perf_counter() - begin)
        return wide

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
        begin = time.perf_counter()
        ldr = develop(linear, transform, alpha=alpha)
        self.develop_seconds.append(time.perf_counter() - begin)
        return ldr


def metered_shots(
    renderer: RunRenderer,
    shots: Sequence[Shot],
    of: ExposureOf,
    exposure_ev: float = 0.0,
    frames: float = 0.0,
) -> list[Shot]:
    """Return shots with the exposures that a metering rule gives small pictures of them.

    Args:
        renderer: renders.
        shots: in the order in which they are shown.
        of: the rule.
        exposure_ev: stops more than that.
        frames: exposures follow what is seen within about this many; 0: each by itself.
    """
    run = renderer.run
    logs = []
    for shot in shots:
        small = shot.resized(METERED_WIDTH) if shot.width > METERED_WIDTH else shot
        rendered = run.render(small.camera(), small.time)
        readings = meter(np.asarray(rendered.linear), np.asarray(rendered.alpha))
        logs.append(run.metering.log_exposure(readings, of))
    if frames > 0:
        logs = adapted(np.array(logs), frames).tolist()
    mean = np.log(run.mean.exposure_geometric)
    stops = [(float(log) - float(mean)) / LN2 + exposure_ev for log in logs]
    return [replace(shot, exposure_ev=ev) for shot, ev in zip(shots, stops, strict=True)]


def shot_frames(
    renderer: RunRenderer,
    shots: Sequence[Shot],
    display_of: Callable[[Shot], DisplayTransform],
    photograph: Callable[[int], Float32[np.ndarray, "h w 3"] | None] | None = None,
) -> Iterator[OutputFrame]:
    """Yield a frame for every shot.

    Args:
        renderer: renders.
        shots: what to render.
        display_of: how to develop each.
        photograph: returns the photograph to write beside the render of a view, or None.
    """
    for shot in shots:
        linear, alpha, depth = renderer.linear(shot)
        transform = display_of(shot)
        ldr = renderer.develop(linear, transform, alpha)
        taken = None if photograph is None or shot.view is None else photograph(shot.view)
        yield OutputFrame(shot.name, linear, alpha, ldr, transform, depth, shot.camera(), taken)


def wide_frames(
    renderer: RunRenderer,
    cylinder: Cylinder,
    poses: Poses,
    transform: DisplayTransform,
    times: Sequence[float | None],
) -> Iterator[OutputFrame]:
    """Yield wide views of the field.

    Args:
        renderer: renders.
        cylinder: the view from a rig: its viewmat is rig-to-camera.
        poses: rig-to-world.
        transform: how to develop all.
        times: of the poses, seconds; None: what moves is not shown.
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
    the field's smoothed depth, and nothing is blended. The frame's `linear` is the field.

    Args:
        renderer: renders.
        rig: the cameras.
        steps: of the rig.
        cylinder: the view from the rig: its viewmat is rig-to-camera.
        transform: the common one.
        store: the photographs.
    """
    names = list(rig.mounts)
    mean = renderer.run.mean.exposure_geometric
    for step in steps:
        placed = _placed(cylinder, step.pose)
        wide = renderer.wide(placed, step.time)
        shots = [step.shots[name] for name in names if name in step.shots]
        rows = [shot.view for shot in shots if shot.view is not None]
        transforms = [renderer.run.own_display(row) for row in rows]
        photographs, masks = zip(*(store.get(row) for row in rows), strict=True)
        radiance = [undevelop(p, own) for p, own in zip(photographs, transforms, strict=True)]
        near = cv2.GaussianBlur(wide.nearness, (0, 0), SMOOTH * cylinder.width)
        taken = stitch(photographs, shots, placed, near, masks)
        same = stitch(radiance, shots, placed, near, masks)
        seen = taken.source[..., None] >= 0
        stops = [float(np.log2(own.exposure / mean)) for own in transforms]
        cameras = [name for name in names if name in step.shots]
        captions = [
            (f"{short_name(cameras[k])} {stops[k]:+.1f} EV".replace("-", "−"), start, end)
            for k, start, end in borders(taken.source[cylinder.height // 2])
        ]
        field = renderer.develop(wide.linear, transform, wide.alpha)
        picture = stacked(
            [
                CaptionedImage(
                    "photographs as taken", np.where(seen, taken.image, NOTHING), captions
                ),
                CaptionedImage(
                    "the same photographs, developed to one exposure",
                    np.where(seen, develop(same.image, transform), NOTHING),
                ),
                CaptionedImage("the radiance field at that exposure", field),
            ]
        )
        yield OutputFrame(step.name, wide.linear, wide.alpha, picture, transform)


def _placed(cylinder: Cylinder, pose) -> Cylinder:
    return replace(cylinder, viewmat=cylinder.viewmat @ inverse(pose))
