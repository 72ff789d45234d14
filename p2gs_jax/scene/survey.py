"""What there is to fit, without fitting: counted, for every format. Nothing long is computed."""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import PhotographsAlone, Video, find_scene, with_what_lies_beside
from p2gs_jax.scene.convert.readers import exif_evs
from p2gs_jax.scene.drives.assemble import SWEEP_SLACK_S, assemble
from p2gs_jax.scene.drives.recording import Recording, chosen_frames
from p2gs_jax.scene.files import Report, image_size
from p2gs_jax.scene.rigid import camera_centers, time_order
from p2gs_jax.scene.video import expected_frames, video_size
from p2gs_jax.types import Scene


@dataclass(frozen=True)
class SurveyedCamera:
    """One physical camera, or photographs of one size where nothing else is known.

    Sizes and focal lengths are pixels, `across` the angle of view in degrees, `own_car` the share
    of the picture that shows the car itself, `ev` the range of log2(time ISO / N^2), stops.
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
    """What there is; `scene` is None for photographs alone, `format` as in `DataConfig`.

    A drive has `frames`, moments, of which the cameras lack `missing` photographs; `seconds` are
    from the first to the last. The `way` is that of the camera with the most photographs, metres;
    `lacks` says in words what a drive may have and this scene lacks.
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


def survey(root: Path, cfg: DataConfig, report: Report = lambda message: None) -> Survey:
    """Return what a folder holds, with the options of a fit; missing photographs are counted.

    Raises UserError: there is no scene, or it is broken.
    """
    cfg = dataclasses.replace(cfg, allow_missing=True)
    found = find_scene(root, cfg, report)
    if isinstance(found, PhotographsAlone):
        return Survey(Path(root), "images", _sizes(found), lacks=("cameras", "points"))
    if isinstance(found, Video):
        camera = SurveyedCamera("", expected_frames(found.path) or 0, video_size(found.path))
        return Survey(Path(root), "video", (camera,), lacks=("cameras", "points"))
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
    views, names = scene.views, sorted({view.camera for view in scene.views})
    by_camera = {n: sorted((v for v in views if v.camera == n), key=time_order) for n in names}
    times = [view.time for view in views if view.time is not None]
    lacking = {
        "points (they are triangulated when a fit starts)": not len(scene.points),
        "LiDAR sweeps": frames and not sweeps,
        "boxes": frames and not scene.objects,
        "exposures in EXIF": all(view.exif_ev is None for view in views),
    }
    longest = camera_centers(np.stack([v.viewmat for v in max(by_camera.values(), key=len)]))
    way = float(np.linalg.norm(np.diff(longest, axis=0), axis=1).sum())
    cameras = []
    for name, taken in by_camera.items():
        view, (focal, ev) = taken[0], (float(taken[0].K[0, 0]), _range([v.exif_ev for v in taken]))
        across = float(np.rad2deg(2 * np.arctan(view.width / 2 / focal)))
        lens = "" if view.distortion is None else view.distortion.model
        bonnet = None if view.own_car is None else float(view.own_car.mean())
        seen = (len(taken), (view.width, view.height), focal, across, lens, bonnet, ev)
        cameras.append(SurveyedCamera(name, *seen))
    seconds = max(times) - min(times) if times else None
    missing = frames * len(by_camera) - len(views) if frames else 0
    lacks = tuple(what for what, absent in lacking.items() if absent)
    way = way if frames else None
    given = (tuple(cameras), scene, frames, seconds, way, missing, sweeps, lacks)
    return Survey(scene.root, scene.format, *given)


def _range(values: Sequence[float | None]) -> tuple[float, float] | None:
    known = [v for v in values if v is not None]
    return (min(known), max(known)) if known else None


def _sizes(found: PhotographsAlone) -> tuple[SurveyedCamera, ...]:
    """Return photographs by size: more is not known before their cameras are."""
    by_size: dict[tuple[int, int], list[Path]] = defaultdict(list)
    for path in found.paths:
        by_size[image_size(path)].append(path)
    return tuple(
        SurveyedCamera("", len(paths), size, ev=_range(exif_evs(paths)))
        for size, paths in sorted(by_size.items(), key=lambda item: -len(item[1]))
    )


def labels_of(scene: Scene) -> list[tuple[str, int, int]]:
    """Return what is tracked: label, how many, how many of them move; the most common first."""
    counts = Counter(thing.label for thing in scene.objects)
    moving = Counter(thing.label for thing in scene.objects if thing.moving)
    return [(label, count, moving[label]) for label, count in counts.most_common()]
