"""The frames of `render`: their cameras, and how each is developed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from p2gs_jax.cli.render import FPS, Render
from p2gs_jax.errors import UserError
from p2gs_jax.formats.frames import OutputFrame
from p2gs_jax.paths import pictures
from p2gs_jax.paths.drive import PosePath, beside, beside_shots, drive, interpolated
from p2gs_jax.paths.orbit import find_orbit, orbit
from p2gs_jax.paths.panorama import covering
from p2gs_jax.paths.rig import find_rig
from p2gs_jax.paths.shots import Shot, of_camera, view_shots
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.run.read import Run

Photograph = Callable[[int], Float32[np.ndarray, "h w 3"] | None]  # by the row of its view
# A metered exposure follows changes of the picture within about this time, seconds.
ADAPT_S = 0.5


@dataclass(frozen=True)
class Job:
    """Frames to render, one by one as the iterator advances."""

    frames: Iterator[OutputFrame]
    count: int
    size: tuple[int, int]  # width and height of the largest, pixels
    shots: Sequence[Shot] = ()  # cameras that can be kept as a file; panoramas have none
    notes: Sequence[str] = ()  # notes for the user


def _display_transform(fitted: Run, options: Render, shot: Shot | None = None) -> DisplayTransform:
    """Return the display transform of a shot's photograph or exposure; the options change it."""
    if shot is not None and shot.view is not None:
        transform = fitted.own_display(shot.view)
    else:
        ev = None if shot is None else shot.exposure_ev
        transform = fitted.common_display(0.0 if ev is None else ev)
    ev = options.exposure_ev
    if options.meter is not None and shot is not None and shot.exposure_ev is not None:
        ev = shot.exposure_ev  # includes --exposure-ev
    if isinstance(ev, float | int):
        # The correction and the white balance of a view hold the exposure of its photograph.
        common = fitted.common_display(float(ev))
        transform = replace(common, gamma=transform.gamma, camera=transform.camera)
    if options.white_balance_of is not None:
        balance = fitted.white_balance_of(options.white_balance_of)
        transform = replace(transform, white_balance=balance)
    if options.no_vignetting:
        transform = transform.without_place()
    gamma = options.gamma
    if gamma is None and shot is not None:
        gamma = shot.gamma
    if gamma is not None:
        transform = replace(transform, gamma=gamma)
    return transform if options.curve == "run" else transform.with_curve(options.curve)


def _chosen(options: Render, fitted: Run) -> list[Shot]:
    """Return shots of the views that `--split` leaves."""
    shots = view_shots(fitted.scene.views, fitted.cfg.data.max_width)
    pairs = zip(shots, fitted.scene.views, strict=True)
    chosen = [shot for shot, view in pairs if options.split in ("all", view.split)]
    if not chosen:
        raise UserError(f"The scene has no view of --split {options.split}.")
    return chosen


def shots_of(
    options: Render, fitted: Run, listed: list[Shot] | None, say: Callable[[str], None]
) -> Job:
    """Return the job of rendering pinhole cameras; those `listed` in a file replace the scene's.

    `say` shows the user a note while frames are rendered. Raises a UserError if the scene has no
    such views.
    """
    notes, photograph = [], None
    views = fitted.scene.views
    if listed is not None:
        shots = listed
    elif options.trajectory == "views":
        chosen = _chosen(options, fitted)
        shots = chosen if options.camera is None else of_camera(chosen, views, options.camera)
        photograph = _photographs(fitted, say)
    else:
        chosen = _chosen(options, fitted)
        filmed = of_camera(chosen, views, options.camera)
        if options.trajectory == "drive":
            shots = drive(_recorded(filmed, options, fitted), options.frames)
            if options.shift is not None:
                shots = beside_shots(shots, views, options.shift)
        else:
            circle = find_orbit(chosen, filmed, np.asarray(fitted.scene.points, np.float64))
            shots = orbit(circle, filmed, options.frames)
    if options.width is not None:
        shots = [shot.resized(options.width) for shot in shots]
    if options.meter is not None:
        added = options.exposure_ev if isinstance(options.exposure_ev, float | int) else 0.0
        adapt_frames = ADAPT_S * (options.fps or FPS) if options.trajectory != "views" else 0.0
        shots = pictures.metered_shots(fitted, shots, options.meter, added, adapt_frames)
        if options.meter == "auto":
            notes = [*notes, fitted.metering.sentence]
    size = (max(s.width for s in shots), max(s.height for s in shots))
    frames = pictures.shot_frames(
        fitted, shots, lambda shot: _display_transform(fitted, options, shot), photograph
    )
    return Job(frames, len(shots), size, shots, notes)


def _photographs(fitted: Run, say: Callable[[str], None]) -> Photograph:
    """Return a function that loads a view's photograph; `say` reports the first missing one."""
    missing = []

    def of(index: int) -> Float32[np.ndarray, "h w 3"] | None:
        try:
            return fitted.photograph(index)
        except UserError as error:
            if not missing:
                say(f"Views without their photographs are NAME.png alone: {error.message}")
            missing.append(index)
            return None

    return of


def _recorded(shots: list[Shot], options: Render, fitted: Run) -> list[Shot]:
    """Return shots with the exposures and gammas of their photographs for `--exposure-ev own`."""
    if options.exposure_ev != "own":
        return shots
    transforms = [fitted.own_display(shot.view) for shot in shots if shot.view is not None]
    mean = fitted.mean.exposure_geometric
    return [
        replace(shot, exposure_ev=math.log2(transform.exposure / mean), gamma=transform.gamma)
        for shot, transform in zip(shots, transforms, strict=True)
    ]


def panoramas_of(options: Render, fitted: Run) -> Job:
    """Return the job of rendering panoramas; UserError: no such rig or time step."""
    views = fitted.scene.views
    rig = find_rig(view_shots(views, fitted.cfg.data.max_width), views)
    cylinder = covering(rig.mounts.values(), np.eye(4))
    if options.width is not None:
        cylinder = cylinder.resized(options.width)
    notes = []
    allowed = {shot.view for shot in _chosen(options, fitted)}
    shown = [s for s in rig.steps if any(shot.view in allowed for shot in s.shots.values())]
    if options.trajectory == "drive":
        if len(shown) < 2:
            why = f"A drive needs two time steps; --split {options.split} leaves {len(shown)}."
            fix = "use --trajectory views" + ", or --split all" * (options.split != "all")
            raise UserError(why, fix=fix)
        path = PosePath(np.stack([step.pose for step in shown]))
        along = path.evenly(options.frames)
        poses = path(along)
        times = interpolated(path.times, [step.time for step in shown], along)
        if options.shift is not None:
            poses = beside(poses, views, options.shift)
        steps = list(zip([f"{k:05d}" for k in range(len(poses))], poses, times, strict=True))
    else:
        if not shown:
            raise UserError(f"The rig has no time step of --split {options.split}.")
        steps = [(step.name, step.pose, step.time) for step in shown]
        alone = len(views) - sum(len(step.shots) for step in rig.steps)
        if alone:
            notes.append(f"{alone} views are left out: no other camera has a view at their time.")
    frames = pictures.wide_frames(fitted, cylinder, steps, _display_transform(fitted, options))
    return Job(frames, len(steps), (cylinder.width, cylinder.height), (), notes)
