"""What there is to fit, without fitting: counted, for every format, and drawn from above.

Nothing long is computed. In the picture the drive goes to the right.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.core.text import names_as_they_are, printable
from p2gs_jax.scene import PhotographsAlone, Video, find_scene, with_what_lies_beside
from p2gs_jax.scene.cache import Report
from p2gs_jax.scene.convert.headers import read_exif_ev
from p2gs_jax.scene.drives.assemble import SWEEP_SLACK_S, assemble
from p2gs_jax.scene.drives.recording import Recording, chosen_frames
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.rigid import camera_centers, interpolated, level_ahead, time_order, up_of_drive
from p2gs_jax.scene.video import expected_frames, video_size
from p2gs_jax.types import Scene, TrackedObject, View

# Colours by Okabe and Ito, which most people with colour blindness tell apart.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F3C8D", "#6B6B3A")
POINT, MOVING_POINT, STANDING, MOVING = "#b4b8bd", "#e8824a", "#5d646b", "#c0392b"
MOST_POINTS, MOST_DIRECTIONS = 80_000, 9
# What is drawn: this share of the points, no farther from the way than so many scene units or
# lengths of the way.
SHARE, AROUND, AROUND_WAYS = 0.9, 60.0, 0.6
_CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) / 2


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
    from the first to the last. The `way` is that of the camera with the most photographs, scene
    units; `lacks` says in words what a drive may have and this scene lacks.
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
        """The unit of lengths: data sets of drives are metric."""
        return "m" if self.scene is not None and _metric(self.format) else "scene units"


def _metric(name: str) -> bool:
    return name not in ("colmap", "transforms")


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
    views, by_camera = scene.views, _by_camera(scene.views)
    times = [view.time for view in views if view.time is not None]
    lacking = {
        "points (they are triangulated when a fit starts)": not len(scene.points),
        "LiDAR sweeps": frames and not sweeps,
        "boxes": frames and not scene.objects,
        "exposures in EXIF": all(view.exif_ev is None for view in views),
    }
    longest = camera_centers(_viewmats(max(by_camera.values(), key=len)))
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


def _by_camera(views: Sequence[View]) -> dict[str, list[View]]:
    """Return the views of each camera in the order of time, cameras sorted by name."""
    names = sorted({view.camera for view in views})
    return {name: sorted((v for v in views if v.camera == name), key=time_order) for name in names}


def _viewmats(views: Sequence[View]) -> np.ndarray:
    return np.stack([view.viewmat for view in views]).astype(np.float64)


def _range(values: Sequence[float | None]) -> tuple[float, float] | None:
    known = [v for v in values if v is not None]
    return (min(known), max(known)) if known else None


def _sizes(found: PhotographsAlone) -> tuple[SurveyedCamera, ...]:
    """Return photographs by size: more is not known before their cameras are."""
    by_size: dict[tuple[int, int], list[Path]] = defaultdict(list)
    for path in found.paths:
        by_size[image_size(path)].append(path)
    return tuple(
        SurveyedCamera("", len(paths), size, ev=_range([read_exif_ev(path) for path in paths]))
        for size, paths in sorted(by_size.items(), key=lambda item: -len(item[1]))
    )


def labels_of(scene: Scene) -> list[tuple[str, int, int]]:
    """Return what is tracked: label, how many, how many of them move; the most common first."""
    counts = Counter(thing.label for thing in scene.objects)
    moving = Counter(thing.label for thing in scene.objects if thing.moving)
    return [(label, count, moving[label]) for label, count in counts.most_common()]


def _ground(views: Sequence[View]) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from points [n 3] to the ground [n 2], the drive from left to right."""
    up = up_of_drive(_viewmats(views), [view.camera for view in views])
    longest = camera_centers(_viewmats(max(_by_camera(views).values(), key=len)))
    way = longest[-1] - longest[0]
    way -= up * (up @ way)
    if np.linalg.norm(way) < 1e-6:
        way = level_ahead(views, up)
    along = way / max(np.linalg.norm(way), 1e-12)
    axes = np.stack([along, np.cross(up, along)])
    return lambda points: (np.asarray(points, np.float64) - longest[0]) @ axes.T


@names_as_they_are()
def draw_plan(path: Path, survey: Survey) -> None:
    """Write a PNG of a scene from above: cameras with their directions, points, boxes.

    Raises ValueError: the survey has no cameras.
    """
    # Imported here: it takes as long to load as a small scene to read.
    from matplotlib.figure import Figure

    scene = survey.scene
    if scene is None:
        raise ValueError("photographs alone have no plan")
    ground = _ground(scene.views)
    points = ground(scene.points if scene.lidar is None else scene.lidar.points)
    low, high = _limits(ground(camera_centers(_viewmats(scene.views))), points, scene.format)
    across, down = high - low
    tall = float(np.clip(13.0 * down / max(across, 1e-9), 4.0, 11.0))
    figure = Figure(figsize=(13.0, tall + 0.9), layout="constrained", dpi=110)
    axes = figure.subplots()
    _draw_points(axes, points, scene, low, high)
    times = [view.time for view in scene.views if view.time is not None]
    for thing in scene.objects if times else ():
        _draw_box(axes, ground, thing, min(times), max(times))
    for k, (name, views) in enumerate(_by_camera(scene.views).items()):
        color, reach = COLORS[k % len(COLORS)], 0.055 * float(max(across, down))
        _draw_camera(axes, ground, f"{printable(name)} ({len(views)})", views, color, reach)
    if survey.frames is not None:
        axes.plot(0, 0, "o", mec="black", mew=1.3, mfc="none", ms=9, zorder=6, label="start")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel=survey.unit)
    title = f"{printable(survey.root.resolve().name)} from above"
    if survey.way:
        title += f": {survey.way:.1f} {survey.unit} to the right"
        title += "" if survey.seconds is None else f" in {survey.seconds:.1f} s"
    axes.set_title(title, loc="left", fontsize=11)
    handles, labels = axes.get_legend_handles_labels()
    how = {"ncols": min(6, len(labels)), "fontsize": 8, "frameon": False, "markerscale": 1.6}
    figure.legend(handles, labels, loc="outside lower left", **how)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png")


def _limits(places: np.ndarray, points: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of what is drawn: the cameras, and most of the points around them."""
    low, high = places.min(0), places.max(0)
    way = float(np.linalg.norm(high - low))
    reach = 0.3 * way
    if len(points):
        reach = float(np.quantile(np.abs(np.clip(points, low, high) - points).max(1), SHARE))
    most = max(AROUND, AROUND_WAYS * way) if _metric(name) else 5 * max(way, 1e-6)
    margin = max(min(reach, most), 0.1 * way, 1e-6)
    return low - margin, high + margin


def _draw_points(axes, points: np.ndarray, scene: Scene, low, high) -> None:
    moving = np.zeros(len(points), bool) if scene.lidar is None else scene.lidar.objects >= 0
    inside = np.flatnonzero(((points >= low) & (points <= high)).all(1))
    if len(inside) > MOST_POINTS:
        inside = generator(0, Stream.PLAN_POINTS).choice(inside, MOST_POINTS, replace=False)
    what = "points" if scene.lidar is None else "LiDAR"
    for rows, color, label in (
        (inside[~moving[inside]], POINT, what),
        (inside[moving[inside]], MOVING_POINT, f"{what} on moving boxes"),
    ):
        if len(rows):
            axes.plot(*points[rows].T, ",", color=color, zorder=1, rasterized=True)
            axes.plot([], [], "s", color=color, ms=4, label=label)


def _draw_box(axes, ground, thing: TrackedObject, first: float, last: float) -> None:
    """Draw where a box was first and last while photographs were taken, and its track."""
    within = thing.times[(thing.times >= first) & (thing.times <= last)]
    if not len(within):
        return
    color = MOVING if thing.moving else STANDING
    label = "moving boxes and their tracks" if thing.moving else "standing boxes"
    known = label in axes.get_legend_handles_labels()[1]
    corners = np.concatenate([_CORNERS * thing.size[:2], np.zeros((5, 1))], 1)
    track = interpolated(thing.times, thing.poses, within)[0]
    for k, pose in enumerate(track[[0, -1]] if thing.moving else track[:1]):
        outline, named = ground(corners @ pose[:3, :3].T + pose[:3, 3]), not known and k == 0
        axes.plot(*outline.T, color=color, lw=0.9, zorder=3, label=label if named else None)
    if thing.moving:
        axes.plot(*ground(track[:, :3, 3]).T, color=color, lw=0.7, ls=(0, (3, 2)), zorder=3)


def _draw_camera(axes, ground, label: str, views: Sequence[View], color: str, reach: float) -> None:
    """Draw the way of a camera, and what it sees from some places of it."""
    centers = camera_centers(_viewmats(views))
    axes.plot(*ground(centers).T, ".-", color=color, ms=3, lw=0.8, zorder=5, label=label)
    for k in evenly_spaced(len(views), MOST_DIRECTIONS):
        view, place = views[k], ground(centers[k])
        sides = (np.array([0.0, view.width]) - view.K[0, 2]) / view.K[0, 0]
        rays = np.stack([sides, np.zeros(2), np.ones(2)], -1) @ view.viewmat[:3, :3]
        rays = ground(centers[k] + rays) - place
        rays *= reach / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        corners = np.stack([place + rays[0], place, place + rays[1]])
        axes.fill(*corners.T, color=color, alpha=0.16, lw=0, zorder=2)
        axes.plot(*corners.T, color=color, lw=0.6, zorder=4)
