"""What there is to fit, without fitting: counted, of every format; nothing long is computed."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import PhotographsAlone, Video, find_scene, with_what_lies_beside
from p2gs_jax.scene.drives.assemble import SWEEP_SLACK_S, assemble
from p2gs_jax.scene.drives.recording import (
    Recording,
    chosen_frames,
)
from p2gs_jax.scene.exif import read_exif_ev
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.video.frames import expected_frames, video_size
from p2gs_jax.types import Scene, View


@dataclass(frozen=True)
class SurveyedCamera:
    """One physical camera, or of photographs alone one size.

    Attributes:
        name: of the camera; empty where nothing is known of it.
        photographs: how many.
        size: width and height, pixels.
        focal: length in pixels, or None.
        across: angle of view from side to side, degrees, or None.
        lens: what distorts, in words; empty: nothing.
        own_car: share of the picture that shows the car itself, or None.
        ev: least and largest log2(time ISO / N^2) of EXIF, stops, or None.
    """

    name: str
    photographs: int
    size: tuple[int, int]
    focal: float | None = None
    across: float | None = None
    lens: str = ""
    own_car: float | None = None
    ev: tuple[float, float] | None = None


@dataclass(frozen=True)
class Survey:
    """What there is.

    Attributes:
        root: the folder.
        format: as `DataConfig.format` names it.
        cameras: by name.
        scene: views, points, boxes; None: photographs alone.
        frames: moments in a drive, or None where views have none.
        seconds: from the first photograph to the last, or None.
        way: of the camera with the most photographs, scene units, or None where views have no
            frames.
        missing: photographs that the cameras lack in these frames.
        sweeps: of laser scanners, or None.
        lacks: what a drive may have and this scene has not, in words.
    """

    root: Path
    format: str
    cameras: tuple[SurveyedCamera, ...]
    scene: Scene | None = None
    frames: int | None = None
    seconds: float | None = None
    way: float | None = None
    missing: int = 0
    sweeps: int | None = None
    lacks: tuple[str, ...] = ()

    @property
    def photographs(self) -> int:
        """How many there are."""
        return sum(camera.photographs for camera in self.cameras)

    @property
    def unit(self) -> str:
        """Of lengths: data sets of drives are metric."""
        known = self.scene is not None and self.format not in ("colmap", "transforms")
        return "m" if known else "scene units"


def survey(
    root: Path, cfg: DataConfig, report: Callable[[str], None] = lambda message: None
) -> Survey:
    """Return what a folder holds; missing photographs are counted.

    Args:
        root: of the scene.
        cfg: as of a fit.
        report: receives progress.

    Raises:
        UserError: there is no scene, or it is broken.
    """
    cfg = dataclasses.replace(cfg, allow_missing=True)
    found = find_scene(root, cfg, report)
    if isinstance(found, PhotographsAlone):
        return Survey(Path(root), "images", _sizes(found), lacks=("cameras", "points"))
    if isinstance(found, Video):
        of_video = SurveyedCamera("", expected_frames(found.path) or 0, video_size(found.path))
        return Survey(Path(root), "video", (of_video,), lacks=("cameras", "points"))
    sweeps, frames = None, None
    if isinstance(found, Recording):
        scene = assemble(found, cfg, None, report, write_embedded=False)
        every = sorted({photograph.frame for photograph in found.photographs})
        frames = len(chosen_frames(cfg.frames, every))
        times = [view.time for view in scene.views if view.time is not None]
        first, last = min(times) - SWEEP_SLACK_S, max(times) + SWEEP_SLACK_S
        sweeps = sum(first <= sweep.time <= last for sweep in found.sweeps)
    else:
        scene = found
    scene = with_what_lies_beside(scene, cfg)
    return _of_scene(scene, frames, sweeps)


def _of_scene(scene: Scene, frames: int | None, sweeps: int | None) -> Survey:
    views = scene.views
    by_camera = {name: [v for v in views if v.camera == name] for name in cameras_of(scene)}
    times = [view.time for view in views if view.time is not None]
    most = max(by_camera.values(), key=len)
    lacks = []
    if not len(scene.points):
        lacks.append("points (they are triangulated when a fit starts)")
    if frames and not sweeps:
        lacks.append("LiDAR sweeps")
    if frames and not scene.objects:
        lacks.append("boxes")
    if all(view.exif_ev is None for view in views):
        lacks.append("exposures in EXIF")
    return Survey(
        scene.root,
        scene.format,
        tuple(_camera(name, taken) for name, taken in by_camera.items()),
        scene,
        frames,
        max(times) - min(times) if times else None,
        way_of(most) if frames else None,
        frames * len(by_camera) - len(views) if frames else 0,
        sweeps,
        tuple(lacks),
    )


def cameras_of(scene: Scene) -> list[str]:
    """Return the names of a scene's cameras, sorted."""
    return sorted({view.camera for view in scene.views})


def centers_of(views: Sequence[View]) -> np.ndarray:
    """Return positions of cameras [v 3], in the order of frames where they have any."""
    ordered = sorted(views, key=lambda v: (v.frame if v.frame is not None else -1, v.name))
    viewmats = np.stack([view.viewmat for view in ordered]).astype(np.float64)
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def way_of(views: Sequence[View]) -> float:
    """Return the length of a camera's way, scene units."""
    return float(np.linalg.norm(np.diff(centers_of(views), axis=0), axis=1).sum())


def _camera(name: str, views: Sequence[View]) -> SurveyedCamera:
    view = views[0]
    focal = float(view.K[0, 0])
    car = view.own_car
    return SurveyedCamera(
        name,
        len(views),
        (view.width, view.height),
        focal,
        float(np.rad2deg(2 * np.arctan(view.width / 2 / focal))),
        "" if view.distortion is None else view.distortion.model,
        None if car is None else float(car.mean()),
        _range([v.exif_ev for v in views]),
    )


def _range(values: Sequence[float | None]) -> tuple[float, float] | None:
    known = [v for v in values if v is not None]
    return (min(known), max(known)) if known else None


def _sizes(found: PhotographsAlone) -> tuple[SurveyedCamera, ...]:
    """Return photographs by size: more is not known before their cameras are."""
    sizes = {path: image_size(path) for path in found.paths}
    return tuple(
        SurveyedCamera(
            "", count, size, ev=_range([read_exif_ev(p) for p, s in sizes.items() if s == size])
        )
        for size, count in Counter(sizes.values()).most_common()
    )


def labels_of(scene: Scene) -> list[tuple[str, int, int]]:
    """Return what is tracked: label, how many, how many of them move; the most common first."""
    counts = Counter(thing.label for thing in scene.objects)
    moving = Counter(thing.label for thing in scene.objects if thing.moving)
    return [(label, count, moving[label]) for label, count in counts.most_common()]
