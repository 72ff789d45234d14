"""A scene from above: cameras with their directions, points, boxes; the drive goes to the right."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.core.text import names_as_they_are, printable
from p2gs_jax.scene.rigid import interpolated, level_ahead, up_of_drive
from p2gs_jax.scene.survey import Survey, cameras_of, centers_of
from p2gs_jax.types import Scene, TrackedObject, View

# Of Okabe and Ito, told apart with most colour blindness; more cameras get other marks as well.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F3C8D", "#6B6B3A")
POINT, MOVING_POINT, STANDING, MOVING = "#b4b8bd", "#e8824a", "#5d646b", "#c0392b"
MOST_POINTS, MOST_DIRECTIONS = 80_000, 9
# What is drawn: this share of the points, no farther from the way than so many scene units or
# lengths of the way.
SHARE, AROUND, AROUND_WAYS = 0.9, 60.0, 0.6
_STEPS = (1, 2, 5)
_CORNERS = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) / 2


class _Plane:
    """The ground, with the drive from left to right."""

    def __init__(self, views: Sequence[View]):
        viewmats = np.stack([v.viewmat for v in views]).astype(np.float64)
        up = up_of_drive(viewmats, [v.camera for v in views])
        cameras = [[v for v in views if v.camera == name] for name in {v.camera for v in views}]
        longest = centers_of(max(cameras, key=len))
        way = longest[-1] - longest[0]
        way -= up * (up @ way)
        if np.linalg.norm(way) < 1e-6:
            way = level_ahead(views, up)
        along = way / max(np.linalg.norm(way), 1e-12)
        self.axes = np.stack([along, np.cross(up, along)])
        self.start = longest[0]

    def __call__(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        return (np.asarray(points, np.float64) - self.start) @ self.axes.T

    def turned(self, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        return np.asarray(directions, np.float64) @ self.axes.T


@names_as_they_are()
def draw_plan(path: Path, survey: Survey) -> None:
    """Write the picture.

    Args:
        path: the PNG.
        survey: of a scene with cameras.

    Raises:
        ValueError: the survey has none.
    """
    # Imported here: it takes as long to load as a small scene to read.
    from matplotlib.figure import Figure

    scene = survey.scene
    if scene is None:
        raise ValueError("photographs alone have no plan")
    plane = _Plane(scene.views)
    places = plane(centers_of(scene.views))
    low, high = _limits(places, plane, scene)
    across, down = high - low
    width = 13.0
    tall = float(np.clip(width * down / max(across, 1e-9), 4.0, 11.0))
    figure = Figure(figsize=(width, tall + 0.9), layout="constrained", dpi=110)
    axes = figure.subplots()
    _draw_points(axes, plane, scene, low, high)
    for thing in scene.objects:
        _draw_box(axes, plane, thing, scene)
    reach = 0.055 * float(max(across, down))
    for k, name in enumerate(cameras_of(scene)):
        taken = [view for view in scene.views if view.camera == name]
        _draw_camera(axes, plane, name, taken, COLORS[k % len(COLORS)], reach)
    if survey.frames is not None:
        start = {"mec": "black", "mew": 1.3, "mfc": "none", "ms": 9, "zorder": 6}
        axes.plot(0, 0, "o", **start, label="start")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    _draw_scale(axes, low, high, survey.unit)
    axes.set_title(_title(survey), loc="left", fontsize=11)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower left", ncols=min(6, len(labels)), fontsize=8,
        frameon=False, markerscale=1.6,
    )  # fmt: skip
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png")


def _title(survey: Survey) -> str:
    said = f"{printable(survey.root.resolve().name)} from above"
    if survey.way:
        said += f": {survey.way:.1f} {survey.unit} to the right"
        said += "" if survey.seconds is None else f" in {survey.seconds:.1f} s"
    return said


def _limits(places: np.ndarray, plane: _Plane, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of what is drawn: the cameras, and most of the points around them."""
    low, high = places.min(0), places.max(0)
    way = float(np.linalg.norm(high - low))
    points = _measured(scene)
    if len(points):
        flat = plane(points)
        beside = np.abs(np.clip(flat, low, high) - flat).max(1)
        reach = float(np.quantile(beside, SHARE))
    else:
        reach = 0.3 * way
    metric = scene.format not in ("colmap", "transforms")
    most = max(AROUND, AROUND_WAYS * way) if metric else 5 * max(way, 1e-6)
    margin = max(min(reach, most), 0.1 * way, 1e-6)
    return low - margin, high + margin


def _measured(scene: Scene) -> np.ndarray:
    return scene.points if scene.lidar is None else scene.lidar.points


def _draw_points(axes, plane: _Plane, scene: Scene, low, high) -> None:
    points = _measured(scene)
    moving = np.zeros(len(points), bool) if scene.lidar is None else scene.lidar.objects >= 0
    flat = plane(points)
    inside = np.flatnonzero(((flat >= low) & (flat <= high)).all(1))
    if len(inside) > MOST_POINTS:
        inside = generator(0, Stream.PLAN_POINTS).choice(inside, MOST_POINTS, replace=False)
    what = "points" if scene.lidar is None else "LiDAR"
    for mine, color, label in (
        (inside[~moving[inside]], POINT, what),
        (inside[moving[inside]], MOVING_POINT, f"{what} on moving boxes"),
    ):
        if len(mine):
            axes.plot(*flat[mine].T, ",", color=color, zorder=1, rasterized=True)
            axes.plot([], [], "s", color=color, ms=4, label=label)


def _draw_box(axes, plane: _Plane, thing: TrackedObject, scene: Scene) -> None:
    """Draw where a box was first and last while photographs were taken, and its track."""
    times = [view.time for view in scene.views if view.time is not None]
    if not times:
        return
    within = thing.times[(thing.times >= min(times)) & (thing.times <= max(times))]
    ends = within[[0, -1]] if len(within) else np.array([])
    if not len(ends):
        return
    poses, _ = interpolated(thing.times, thing.poses, ends if thing.moving else ends[:1])
    color = MOVING if thing.moving else STANDING
    label = "moving boxes and their tracks" if thing.moving else "standing boxes"
    _, known = axes.get_legend_handles_labels()
    for k, pose in enumerate(poses):
        corners = np.concatenate([_CORNERS * thing.size[:2], np.zeros((5, 1))], 1)
        outline = plane(corners @ pose[:3, :3].T + pose[:3, 3])
        named = {} if k or label in known else {"label": label}
        axes.plot(*outline.T, color=color, lw=0.9, zorder=3, **named)
    if thing.moving:
        track, _ = interpolated(thing.times, thing.poses, within)
        axes.plot(*plane(track[:, :3, 3]).T, color=color, lw=0.7, ls=(0, (3, 2)), zorder=3)


def _draw_camera(
    axes, plane: _Plane, name: str, views: Sequence[View], color: str, reach: float
) -> None:
    """Draw the way of a camera, and what it sees from some places of it."""
    views = sorted(views, key=lambda v: (v.frame if v.frame is not None else -1, v.name))
    places = plane(centers_of(views))
    label = f"{printable(name)} ({len(views)})"
    axes.plot(*places.T, ".-", color=color, ms=3, lw=0.8, zorder=5, label=label)
    for k in evenly_spaced(len(views), MOST_DIRECTIONS):
        view = views[k]
        sides = np.array([[0.0, 0.5], [view.width, 0.5]])
        rays = np.stack([(sides[:, 0] - view.K[0, 2]) / view.K[0, 0], np.zeros(2), np.ones(2)], -1)
        turned = plane.turned(rays @ view.viewmat[:3, :3].astype(np.float64))
        turned *= reach / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        corners = np.stack([places[k], places[k] + turned[0], places[k] + turned[1]])
        axes.fill(*corners.T, color=color, alpha=0.16, lw=0, zorder=2)
        axes.plot(*corners[[1, 0, 2]].T, color=color, lw=0.6, zorder=4)


def _draw_scale(axes, low, high, unit: str) -> None:
    """Draw a bar of a round length in the lower right corner."""
    across, down = high - low
    target = 0.2 * across
    power = 10.0 ** np.floor(np.log10(target))
    length = max(step * power for step in _STEPS if step * power <= target)
    right, base = high[0] - 0.02 * across, low[1] + 0.03 * down
    axes.plot(
        [right - length, right], [base, base], color="black", lw=3, solid_capstyle="butt", zorder=7
    )
    axes.text(
        right - length / 2, base + 0.012 * down, f"{length:g} {unit}", ha="center", va="bottom",
        fontsize=9, zorder=7,
    )  # fmt: skip
