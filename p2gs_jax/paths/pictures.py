"""Pictures of a finished run: renders of shots, and panoramas."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float32

from p2gs_jax.formats.frames import OutputFrame
from p2gs_jax.paths.panorama import Cylinder, Layers, render_wide
from p2gs_jax.paths.shots import Pose, Shot
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.metering import ExposureOf, adapted, meter
from p2gs_jax.run.read import Run
from p2gs_jax.scene.rigid import inverse

# Wider pictures are metered at this width, pixels.
METERED_WIDTH = 240


def _layers(run: Run, shot: Shot, at: float | None) -> Layers:
    """Return linear radiance, alpha and alpha-weighted depth of a shot at a time, seconds."""
    result = run.render(shot.camera(), at)
    return np.asarray(result.linear), np.asarray(result.alpha), np.asarray(result.depth)


def metered_shots(
    run: Run, shots: Sequence[Shot], rule: ExposureOf, exposure_ev: float = 0.0, frames: float = 0.0
) -> list[Shot]:
    """Return shots with the exposures that a metering rule chooses from small pictures of them.

    `exposure_ev`, stops, is added to each. Exposures are smoothed over about `frames` shots in
    their order; with 0 every shot is metered separately.
    """
    stops = []
    for shot in shots:
        small = shot.resized(METERED_WIDTH) if shot.width > METERED_WIDTH else shot
        rendered = run.render(small.camera(), small.time)
        readings = meter(np.asarray(rendered.linear), np.asarray(rendered.alpha))
        stops.append(run.metering.exposure_ev(readings, rule))
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
    """Yield a frame for every shot; `photograph` returns the photograph of a view."""
    for shot in shots:
        linear, alpha, depth = _layers(run, shot, shot.time)
        transform = display_of(shot)
        ldr = develop(linear, transform, alpha=alpha)
        beside = None if photograph is None or shot.view is None else photograph(shot.view)
        yield OutputFrame(shot.name, linear, alpha, ldr, transform, depth, shot.camera(), beside)


def wide_frames(
    run: Run,
    cylinder: Cylinder,
    steps: Iterable[tuple[str, Pose, float | None]],
    transform: DisplayTransform,
) -> Iterator[OutputFrame]:
    """Yield a wide view of the field for each step: name, rig-to-world pose and time, seconds.

    The viewmat of the cylinder is rig-to-camera. Moving objects appear only at a known time.
    """
    for name, pose, at in steps:
        placed = replace(cylinder, viewmat=cylinder.viewmat @ inverse(pose))
        layers = partial(_layers, run, at=at)
        linear, alpha = render_wide(layers, placed)
        yield OutputFrame(name, linear, alpha, develop(linear, transform, alpha=alpha), transform)
