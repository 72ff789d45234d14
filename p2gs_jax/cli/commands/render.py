"""`p2gs-jax render`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.render import PATHS, Render
from p2gs_jax.core.clock import CompileCounter
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.errors import UserError
from p2gs_jax.formats.frames import OutputFrame, open_frames
from p2gs_jax.paths import (
    PosePath,
    Shot,
    covering,
    drive,
    find_orbit,
    find_rig,
    of_camera,
    orbit,
    read_cameras,
    view_shots,
    write_cameras,
)
from p2gs_jax.paths.drive import frame_count, interpolated
from p2gs_jax.paths.files import LARGEST, MOST_STOPS
from p2gs_jax.paths.pictures import (
    RunRenderer,
    comparison_frames,
    comparison_size,
    metered_shots,
    shot_frames,
    wide_frames,
)
from p2gs_jax.paths.shift import beside, beside_shots
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.run.read import Run, load_run

FPS = 24.0
# A metered exposure follows what is seen within about this time, seconds.
ADAPT_S = 0.5
CAMERAS = "cameras.json"
# Sideways, scene units.
MOST_SHIFT = 100.0
OTHER_FILES = (".mov", ".avi", ".mkv", ".webm", ".gif", ".png", ".jpg", ".exr", ".json")


@dataclass(frozen=True)
class Job:
    """Frames to render.

    Attributes:
        frames: rendered one by one as the iterator advances.
        count: of frames.
        size: (width, height) of the largest, pixels.
        shots: cameras that can be kept as a file; none for panoramas.
        notes: what the user should know.
    """

    frames: Iterator[OutputFrame]
    count: int
    size: tuple[int, int]
    shots: Sequence[Shot] = ()
    notes: Sequence[str] = ()


def run(options: Render) -> int:
    """Render a run along a path, into a folder or a video."""
    begin = time.monotonic()
    compiler = CompileCounter()
    _check(options)
    out = options.out or options.run / "renders" / _default_name(options)
    _check_place(out, options.overwrite)
    given = read_cameras(Path(options.path)) if options.path not in PATHS else None
    fitted = load_run(options.run, options.scene)
    fitted = _with_objects(fitted, options)
    if options.curve == "spline" and fitted.cfg.photometry.curve != "spline":
        raise UserError(
            f"--curve spline: {options.run} has none; its curve is {fitted.cfg.photometry.curve}.",
            fix="choose run, srgb, power or linear",
        )
    if options.white_balance_of is not None:
        fitted.white_balance_of(options.white_balance_of)
    renderer = RunRenderer(fitted)
    with TerminalReporter() as reporter:
        job = (
            _panoramas(options, renderer)
            if options.panorama
            else _shots(options, renderer, given, reporter.message)
        )
        reading = time.monotonic() - begin
        for note in job.notes:
            reporter.message(note)
        reporter.stage("Rendering", 0, job.count)
        with open_frames(out, job.size, options.fps or FPS) as write:
            for done, frame in enumerate(job.frames):
                write(frame)
                reporter.stage("Rendering", done + 1, job.count)
        if job.shots and not _is_video(out):
            write_cameras(out / CAMERAS, job.shots)
    what = "frame" if job.count == 1 else "frames"
    console = stdout()
    console.print(f"{job.count} {what}: {out}", soft_wrap=True)
    console.print(_spent(time.monotonic() - begin, reading, compiler.seconds))
    console.print(
        f"A frame takes {_median_ms(renderer.render_seconds)} to render and "
        f"{_median_ms(renderer.develop_seconds)} to expose and encode, whatever exposure and gamma."
    )
    return 0


def _with_objects(fitted: Run, options: Render) -> Run:
    """Return the run with what moves as the options want it.

    Raises:
        UserError: it has none of these objects.
    """
    for name, *offset in options.move_object:
        fitted = fitted.with_moved(name, offset)
    if options.without_objects:
        return fitted.without_objects()
    return fitted.only_objects() if options.only_objects else fitted


def _spent(total: float, reading: float, compiling: float) -> str:
    """Return a sentence on the seconds of a command, part by part."""
    frames = max(total - reading - compiling, 0.0)
    kept = " (kept: the next time is faster)" if compiling >= 1.0 else ""
    return (
        f"{total:.1f} s: {reading:.1f} reading the run, {compiling:.1f} compiling{kept}, "
        f"{frames:.1f} rendering and writing."
    )


def _check_place(out: Path, overwrite: bool) -> None:
    """Refuse to overwrite files, unless asked to."""
    there = out.is_file() or (out.is_dir() and any(out.iterdir()))
    if there and not overwrite:
        what = f"{out} exists already" if out.is_file() else f"{out} holds files already"
        raise UserError(
            f"{what}.", fix="add --overwrite to replace them, or choose another place with --out"
        )


def _median_ms(seconds: list[float]) -> str:
    """Return the median; the first time includes compiling and counts only if it is alone."""
    return f"{1e3 * float(np.median(seconds[1:] or seconds)):.1f} ms"


def _is_video(out: Path) -> bool:
    return out.suffix.lower() == ".mp4"


def _default_name(options: Render) -> str:
    if options.path == "views":
        return "panorama" if options.panorama else "all"
    name = options.path if options.path in PATHS else Path(options.path).stem
    if options.shift:
        name += f"_{abs(options.shift):g}_{'left' if options.shift > 0 else 'right'}"
    return f"{name}_panorama" if options.panorama else name


def _check(options: Render) -> None:
    """Reject options that make no sense, alone or together, before anything is read."""
    path, ev, out = options.path, options.exposure_ev, options.out
    if path not in PATHS and not path.lower().endswith(".json"):
        raise UserError(
            f"--path {path!r} is unknown.", fix="choose views, drive, orbit or a FILE.json"
        )
    if options.exposure_of is not None and (options.panorama or ev == "own"):
        raise UserError(
            "--exposure-of meters pictures of single cameras, instead of --exposure-ev own.",
            fix="leave one of them out",
        )
    if isinstance(ev, float | int) and not abs(ev) <= MOST_STOPS:
        raise UserError(f"--exposure-ev {ev} is no number of stops.", fix="write 0, 1 or -2.5")
    if ev == "own" and (path not in ("views", "drive") or options.panorama):
        raise UserError(
            "--exposure-ev own is for views and drives, and not for panoramas.",
            fix="write a number of stops, or leave it out",
        )
    if options.without_objects and (options.only_objects or options.move_object):
        raise UserError(
            "--without-objects leaves nothing to show or to move.", fix="leave one of them out"
        )
    if not np.isfinite([x for _, *offset in options.move_object for x in offset]).all():
        raise UserError("--move-object wants finite numbers of metres.")
    if options.gamma is not None and not 0 < options.gamma < math.inf:
        raise UserError(
            "--gamma must be positive.",
            fix="write 2.2 for the tone curve as it is, more for less contrast",
        )
    if options.frames is not None and path not in ("drive", "orbit"):
        raise UserError("--frames is for --path drive and orbit.", fix="leave it out")
    if options.shift is not None and path != "drive":
        raise UserError("--shift is for --path drive.", fix="leave it out")
    if options.shift is not None and not abs(options.shift) <= MOST_SHIFT:
        raise UserError(f"--shift must be at most {MOST_SHIFT:g} to either side.")
    if options.frames is not None and options.frames < 2:
        raise UserError("--frames must be 2 or more.")
    if options.width is not None and not 16 <= options.width <= LARGEST:
        raise UserError(f"--width must be between 16 and {LARGEST}.")
    if options.panorama and path not in ("views", "drive"):
        raise UserError(
            "--panorama is for --path views and drive.", fix="choose one of them, or leave it out"
        )
    if options.camera is not None and (options.panorama or path not in PATHS):
        raise UserError("--camera is for single cameras of the scene.", fix="leave it out")
    if options.split != "all" and path not in PATHS:
        raise UserError("--split is for the scene's own views.", fix="leave it out")
    if out is not None and out.suffix.lower() in OTHER_FILES:
        raise UserError(
            f"--out {out}: {out.suffix} files are not written.", fix="name a folder, or NAME.mp4"
        )
    if out is not None and out.exists() and out.is_dir() == _is_video(out):
        kind = "a folder" if out.is_dir() else "a file"
        raise UserError(f"--out {out} is {kind}.", fix="choose another name")
    if options.fps is not None and (out is None or not _is_video(out)):
        raise UserError("--fps is for videos.", fix="write --out NAME.mp4, or leave it out")
    if options.fps is not None and not 1 <= options.fps <= 240:
        raise UserError("--fps must be between 1 and 240.")


def _display_transform(fitted: Run, options: Render, shot: Shot | None = None) -> DisplayTransform:
    """Return a shot's display transform: from the options, else its own, else its photograph's."""
    if shot is not None and shot.view is not None:
        transform = fitted.own_display(shot.view)
    else:
        ev = None if shot is None else shot.exposure_ev
        transform = fitted.common_display(0.0 if ev is None else ev)
    if options.exposure_of is not None and shot is not None and shot.exposure_ev is not None:
        metered = fitted.common_display(shot.exposure_ev)  # with --exposure-ev already
        transform = replace(transform, exposure=metered.exposure)
    elif isinstance(options.exposure_ev, float | int):
        common = fitted.common_display(float(options.exposure_ev))
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
    chosen = [
        shot
        for shot, view in zip(shots, fitted.scene.views, strict=True)
        if options.split in ("all", view.split)
    ]
    if not chosen:
        raise UserError(f"--split {options.split}: the scene has no such view.")
    return chosen


def _shots(
    options: Render, renderer: RunRenderer, given: list[Shot] | None, say: Callable[[str], None]
) -> Job:
    """Return the job of rendering pinhole cameras."""
    fitted, notes, photograph = renderer.run, [], None
    if given is not None:
        shots = given
    else:
        views = fitted.scene.views
        chosen = _chosen(options, fitted)
        if options.path == "views":
            shots = chosen if options.camera is None else of_camera(chosen, views, options.camera)
            photograph = _Photographs(fitted, say)
        else:
            own = of_camera(chosen, views, options.camera)
            if options.path == "drive":
                shots = drive(_recorded(own, options, fitted), options.frames)
                if options.shift is not None:
                    shots = beside_shots(shots, views, options.shift)
            else:
                circle = find_orbit(chosen, own, np.asarray(fitted.scene.points, np.float64))
                shots = orbit(circle, own, options.frames)
                notes = [circle.description()]
    if options.width is not None:
        shots = [shot.resized(options.width) for shot in shots]
    if options.exposure_of is not None:
        added = options.exposure_ev if isinstance(options.exposure_ev, float | int) else 0.0
        frames_s = ADAPT_S * (options.fps or FPS) if options.path != "views" else 0.0
        shots = metered_shots(renderer, shots, options.exposure_of, added, frames_s)
        if options.exposure_of == "auto":
            notes = [*notes, fitted.metering.sentence]
    size = (max(s.width for s in shots), max(s.height for s in shots))
    frames = shot_frames(
        renderer, shots, lambda shot: _display_transform(fitted, options, shot), photograph
    )
    return Job(frames, len(shots), size, shots, notes)


class _Photographs:
    """Photographs to write beside their renders, where they exist."""

    def __init__(self, fitted: Run, say: Callable[[str], None]):
        self._fitted, self._say, self._silent = fitted, say, False

    def __call__(self, index: int) -> Float32[np.ndarray, "h w 3"] | None:
        try:
            return self._fitted.photograph(index)
        except UserError as error:
            if not self._silent:
                self._say(f"Views without their photographs are NAME.png alone: {error.message}.")
            self._silent = True
            return None


def _recorded(shots: list[Shot], options: Render, fitted: Run) -> list[Shot]:
    """Return shots with the exposures and gammas of their photographs where `own` asks for them."""
    if options.exposure_ev != "own":
        return shots
    transforms = [fitted.own_display(shot.view) for shot in shots if shot.view is not None]
    mean = fitted.mean.exposure_geometric
    return [
        replace(shot, exposure_ev=math.log2(transform.exposure / mean), gamma=transform.gamma)
        for shot, transform in zip(shots, transforms, strict=True)
    ]


def _panoramas(options: Render, renderer: RunRenderer) -> Job:
    """Return the job of rendering panoramas of a rig."""
    fitted = renderer.run
    views = fitted.scene.views
    rig = find_rig(view_shots(views, fitted.cfg.data.max_width), views)
    cylinder = covering(rig.mounts.values(), np.eye(4))
    if options.width is not None:
        cylinder = cylinder.resized(options.width)
    transform = _display_transform(fitted, options)
    if options.path == "drive":
        if len(rig.steps) < 2:
            raise UserError(
                "A drive needs at least two time steps; the rig has one.", fix="use --path views"
            )
        path = PosePath(rig.poses)
        along = path.evenly(frame_count(len(rig.steps), options.frames))
        poses = path(along)
        times = interpolated(path.times, [step.time for step in rig.steps], along)
        if options.shift is not None:
            poses = beside(poses, views, options.shift)
        size = (cylinder.width, cylinder.height)
        return Job(wide_frames(renderer, cylinder, poses, transform, times), len(poses), size)
    allowed = {shot.view for shot in _chosen(options, fitted)}
    steps = []
    for step in rig.steps:
        shots = {c: s for c, s in step.shots.items() if s.view in allowed}
        if shots:
            steps.append(replace(step, shots=shots))
    if not steps:
        raise UserError(f"--split {options.split}: the rig has no such time step.")
    notes = []
    alone = len(views) - sum(len(step.shots) for step in rig.steps)
    if alone:
        notes.append(f"{alone} views have no other camera's at their time: they are left out.")
    if fitted.params.appearance is not None:
        notes.append("Corrections of display values that this run learned stay in the photographs.")
    taken = [shot.view for step in steps for shot in step.shots.values() if shot.view is not None]
    fitted.require_photographs(taken)
    frames = comparison_frames(renderer, rig, steps, cylinder, transform, fitted.store)
    return Job(frames, len(steps), comparison_size(cylinder), (), notes)
