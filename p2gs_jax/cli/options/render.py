"""`render`: pictures of a finished run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from p2gs_jax.cli.options.scene import SceneFolder

Metres = Annotated[float | None, tyro.conf.arg(metavar="METRES")]
PATHS = ("views", "drive", "orbit")


@dataclass(frozen=True)
class Render:
    """Render views or a camera path of a run at any exposure.

    p2gs-jax render runs/street --exposure-ev 1 --gamma 2.2 --out brighter
    p2gs-jax render runs/street --path drive --out drive.mp4
    p2gs-jax render runs/street --path drive --shift 2 --out left_lane.mp4
    p2gs-jax render runs/street --panorama --split test --width 1400 --out wide
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    path: str = "views"
    """views: the scene's own. drive: smoothly through the views of one camera. orbit: around what
    the cameras look at. FILE.json: a list of cameras (docs/rendering.md)."""
    out: Path | None = None
    """A folder, for linear EXR and PNG of every frame, or a video, NAME.mp4 (default: a folder
    in RUN/renders)."""
    split: Literal["all", "train", "test"] = "all"
    """Which of the scene's views: held-out ones are test."""
    camera: str | None = None
    """Only the views of this camera; drive and orbit default to that with the most views."""
    panorama: bool = False
    """One wide image of all cameras of a rig. With views, at every time step: the photographs
    stitched as taken, the same developed to one exposure, and the field. With drive: the field."""
    exposure_ev: float | Literal["own"] | None = None
    """Exposure in stops from the geometric mean of the training exposures; own: as photographed
    (on a drive interpolated). Default: own for views, 0 for other paths."""
    exposure_of: Literal["auto", "log_average", "centre", "highlights", "protected"] | None = None
    """Exposure metered from each picture, smoothly along a path: auto: as the camera would have
    chosen it, where a rule explains the photographs; log_average, centre: to mid-grey; highlights:
    to just below white; protected: mid-grey, highlights kept. --exposure-ev then adds stops."""
    gamma: float | None = None
    """Gamma; default: each view's own, or the training views' mean for other paths."""
    curve: Literal["run", "srgb", "power", "linear", "spline"] = "run"
    """Tone curve; run: the one that was fitted."""
    white_balance_of: str | None = None
    """Name of the view whose white balance is shown, where views differ in it (default: each
    view's own; neutral where an exposure is given, and for other paths)."""
    no_vignetting: bool = False
    """Leave out the darkening towards the corners that the cameras of this run have."""
    without_objects: bool = False
    """Leave out what moves."""
    only_objects: bool = False
    """Show only what moves."""
    move_object: Annotated[
        tuple[tuple[str, float, float, float], ...],
        tyro.conf.arg(metavar="NAME X Y Z [NAME X Y Z ...]"),
    ] = ()
    """Show objects this far forward, left and up of where they are (metres, in the frame of their
    box); of a track's name its beginning will do."""
    shift: Metres = None
    """Move a drive sideways, seen from the driving direction: so many metres (scene units) to the
    left; negative ones to the right."""
    frames: int | None = None
    """Frames of a drive (default: 8 from one view to the next) or an orbit (default: 120)."""
    width: int | None = None
    """Image width, pixels; the height follows (default: as the photographs)."""
    fps: float | None = None
    """Frames per second of a video (default: 24)."""
    scene: SceneFolder = None
    """Where the run's scene lies now, if it is not where it was."""
    overwrite: bool = False
    """Replace what an earlier render wrote."""
