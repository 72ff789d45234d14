"""`render`: pictures of a finished run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from p2gs_jax.cli.shared import MeteringRule, PhotometryFolder, RunOrSplats, SceneFolder, check
from p2gs_jax.core.text import count_of
from p2gs_jax.errors import UserError

if TYPE_CHECKING:
    from p2gs_jax.run.read import Run
    from p2gs_jax.types import Scene

PATHS = ("views", "drive", "orbit")
FPS = 24.0  # of a video, by default
MOST_SHIFT = 100.0  # scene units
# Suffixes of files that are not written.
OTHER_SUFFIXES = (".mov", ".avi", ".mkv", ".webm", ".gif", ".png", ".jpg", ".exr", ".json")


@dataclass(frozen=True)
class Render:
    """Render the views of a run, or a camera path, at any exposure.

    p2gs-jax render runs/street --exposure-ev 1 --gamma 2.2 --out brighter
    p2gs-jax render runs/street --trajectory drive --out drive.mp4
    p2gs-jax render runs/street --trajectory drive --shift 2 --out left_lane.mp4
    p2gs-jax render runs/street --panorama --split test --width 1400 --out wide
    p2gs-jax render splat.ply --photometry calibrated --scene castle --out as_photographed
    """

    run: RunOrSplats
    trajectory: str = "views"
    """Camera path. views: the scene's cameras; drive: a smooth path through one camera's views;
    orbit: a circle or arc around the scene; FILE.json: a list of cameras (docs/rendering.md)."""
    out: Path | None = None
    """Folder for linear EXR and PNG files, or a video NAME.mp4 (default: below RUN/renders)."""
    split: Literal["all", "train", "test"] = "all"
    """Subset of the scene's views; test: the held-out views."""
    camera: str | None = None
    """Camera whose views are rendered (default for drive and orbit: that with the most views)."""
    panorama: bool = False
    """Render one wide image of a rig of cameras, at every time step or along a drive."""
    exposure_ev: float | Literal["own"] | None = None
    """Exposure in stops from the geometric mean of the training exposures; own: that of each
    photograph, interpolated on a drive (default: own for views, else 0, also for panoramas)."""
    meter: MeteringRule | None = None
    """Exposure metered from each picture, smoothly along a trajectory. auto: the camera's rule,
    where one explains the photographs; log_average, centre: to mid-grey; highlights: to just below
    white; protected: to mid-grey, highlights kept. --exposure-ev then adds stops."""
    gamma: float | None = None
    """Gamma (default: the view's; for other pictures the mean of the training views)."""
    curve: Literal["run", "srgb", "power", "linear", "spline"] = "run"
    """Tone curve; run: the fitted one."""
    white_balance_of: str | None = None
    """View whose white balance is used (default: that of a picture with its view's exposure, else
    neutral)."""
    no_vignetting: bool = False
    """Leave out the vignetting of the run's cameras."""
    without_objects: bool = False
    """Leave out moving objects."""
    only_objects: bool = False
    """Render only moving objects."""
    shift: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Shift of a drive to the left, metres (scene units); a negative shift is to the right."""
    frames: int | None = None
    """Number of frames of a drive (default: 8 per view) or an orbit (default: 120)."""
    width: int | None = None
    """Image width, pixels; the height follows (default: the photographs' width)."""
    fps: float | None = None
    """Frames per second of a video (default: 24)."""
    scene: SceneFolder = None
    photometry: PhotometryFolder = None
    overwrite: bool = False
    """Replace the files of an earlier render."""

    def execute(self) -> int:
        """Render the run along the path, into a folder or a video."""
        import time

        from p2gs_jax.cli.frames import panoramas_of, shots_of
        from p2gs_jax.core.atomic import write_json
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.formats.frames import open_frames
        from p2gs_jax.paths import files

        begin = time.monotonic()
        for refuse in (_check_picture, _check_path, _check_file):  # before anything is read
            refuse(self)
        given = self.trajectory not in PATHS
        cameras = files.read_cameras(Path(self.trajectory)) if given else None
        fitted = _load(self)
        cameras = None if cameras is None else files.near_scene(cameras, fitted.scene.origin)
        out = self.out or fitted.folder / "renders" / _default_name(self, fitted.scene)
        _check_place(out, self.overwrite)
        list_of_cameras = out / files.CAMERAS
        apart = list_of_cameras.resolve() != Path(self.trajectory).resolve()
        why = f"--trajectory names {list_of_cameras}, which would be replaced"
        check(apart, why, fix="choose another place with --out")
        with TerminalReporter() as reporter:
            job = (
                panoramas_of(self, fitted)
                if self.panorama
                else shots_of(self, fitted, cameras, reporter.message)
            )
            for note in (*fitted.notes, *job.notes):
                reporter.message(note)
            # An earlier render may have had more frames.
            files.remove_rendered(out)
            names = []
            reporter.stage("Rendering", 0, job.count)
            with open_frames(out, job.size, self.fps or FPS) as write:
                for done, frame in enumerate(job.frames):
                    write(frame)
                    names.append(frame.name)
                    reporter.stage("Rendering", done + 1, job.count)
            if job.shots and not is_video(out):
                files.write_cameras(list_of_cameras, job.shots)
            elif not is_video(out):
                write_json(out / files.PANORAMAS, names)
        count, seconds = count_of(job.count, "frame"), time.monotonic() - begin
        PlainConsole().print(f"{count} in {seconds:.1f} s: {out}", soft_wrap=True)
        return 0


def _load(options: Render) -> Run:
    """Return the run; UserError: it has no such object, curve, white balance or vignetting."""
    from p2gs_jax.run.foreign import load_run_or_splats

    fitted = load_run_or_splats(options.run, options.scene, options.photometry)
    if options.curve == "spline":
        fitted.common_display(0.0).with_curve("spline")
    if options.white_balance_of is not None:
        fitted.white_balance_of(options.white_balance_of)
    p = fitted.cfg.photometry
    learned = p.appearance in ("bilateral", "ppisp")
    bare = not (learned or any(camera.vignetting for camera in p.cameras))
    why = f"{fitted.folder} has no vignetting that --no-vignetting could leave out"
    check(not (options.no_vignetting and bare), why, fix="leave the option out")
    if options.without_objects:
        return fitted.without_objects()
    return fitted.only_objects() if options.only_objects else fitted


def _check_place(out: Path, overwrite: bool) -> None:
    occupied = out.is_file() or (out.is_dir() and any(out.iterdir()))
    if occupied and not overwrite:
        why = f"{out} exists already" if out.is_file() else f"{out} holds files already"
        fix = "add --overwrite to replace them, or choose another place with --out"
        raise UserError(f"{why}.", fix=fix)


def is_video(out: Path) -> bool:
    """Return whether frames are written into a video file."""
    return out.suffix.lower() == ".mp4"


def _default_name(options: Render, scene: Scene) -> str:
    """Return a folder name that the fit's renders of held-out views do not use."""
    path = options.trajectory
    name = path if path in PATHS else Path(path).stem
    if path == "views":
        name = options.split
        if options.camera is not None:
            name += "_" + options.camera.replace("/", "_")
    if options.shift:
        name += f"_{abs(options.shift):g}_{'left' if options.shift > 0 else 'right'}"
    if options.without_objects or options.only_objects:
        name += "_without_objects" if options.without_objects else "_only_objects"
    if options.panorama:
        name = "panorama" if name == "all" else f"{name}_panorama"
    return f"{name}_views" if name in {Path(v.name).parts[0] for v in scene.views} else name


def _check_picture(o: Render) -> None:
    from p2gs_jax.options import MOST_STOPS
    from p2gs_jax.paths.files import LARGEST

    path, ev, one = o.trajectory, o.exposure_ev, "leave one of them out"
    valid = path in PATHS or path.lower().endswith(".json")
    fix = "choose views, drive, orbit or a FILE.json"
    check(valid, f"--trajectory {path!r} is not a valid trajectory", fix=fix)
    why = "--meter works neither with --panorama nor with --exposure-ev own"
    check(o.meter is None or not (o.panorama or ev == "own"), why, fix=one)
    why = f"--exposure-ev must be from {-MOST_STOPS:g} to {MOST_STOPS:g} stops"
    check(not isinstance(ev, float | int) or abs(ev) <= MOST_STOPS, why, fix="write 0, 1 or -2.5")
    why = "--exposure-ev own is for views and drives, and not for panoramas"
    fix = "write a number of stops, or leave it out"
    check(ev != "own" or (path in ("views", "drive") and not o.panorama), why, fix=fix)
    why = "--without-objects leaves nothing to show"
    check(not (o.without_objects and o.only_objects), why, fix=one)
    fix = "write 2.2 for the fitted tone curve, and a larger number for less contrast"
    check(o.gamma is None or 0 < o.gamma < math.inf, "--gamma must be positive", fix=fix)
    width_fits = o.width is None or 16 <= o.width <= LARGEST
    check(width_fits, f"--width must be from 16 to {LARGEST} pixels")


def _check_path(o: Render) -> None:
    path, leave = o.trajectory, "leave it out"
    moves, needs = path in ("drive", "orbit"), "is for --trajectory"
    check(o.frames is None or moves, f"--frames {needs} drive and orbit", fix=leave)
    check(o.shift is None or path == "drive", f"--shift {needs} drive", fix=leave)
    near = o.shift is None or abs(o.shift) <= MOST_SHIFT
    check(near, f"--shift must be from {-MOST_SHIFT:g} to {MOST_SHIFT:g} metres")
    check(o.frames is None or o.frames >= 2, "--frames must be at least 2")
    fix = "choose one of them, or leave it out"
    valid = not o.panorama or path in ("views", "drive")
    check(valid, f"--panorama {needs} views and drive", fix=fix)
    why = "--camera works neither with --panorama nor with a FILE.json"
    check(o.camera is None or (path in PATHS and not o.panorama), why, fix=leave)
    valid = o.split == "all" or path in PATHS
    check(valid, "--split does not work with a FILE.json", fix=leave)


def _check_file(o: Render) -> None:
    out = o.out
    if out is not None:
        why = f"--out {out}: {out.suffix} files are not written"
        check(out.suffix.lower() not in OTHER_SUFFIXES, why, fix="name a folder, or NAME.mp4")
        kind = "a folder" if out.is_dir() else "a file"
        valid = not out.exists() or out.is_dir() != is_video(out)
        check(valid, f"--out {out} is {kind}", fix="choose another name")
    video = out is not None and is_video(out)
    fix = "write --out NAME.mp4, or leave it out"
    check(o.fps is None or video, "--fps is for videos", fix=fix)
    check(o.fps is None or 1 <= o.fps <= 240, "--fps must be from 1 to 240")
