"""A far shell of Gaussians for image regions without seed points: sky, hills, far facades.

Each viewing direction without seeds gets a Gaussian far behind the seeds. Scenes whose views are
covered by seeds get no shell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from p2gs_jax.config import FitConfig, InitConfig
from p2gs_jax.core.numerics import fibonacci_sphere
from p2gs_jax.gaussians import seeds
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.visibility import in_frame
from p2gs_jax.types import Gaussians, Photometry, Scene, View

# Each view is divided into cells; a cell counts as covered if it or a neighbour contains a seed.
CELLS_ACROSS = 16
# A direction belongs to the shell if less than this share of the views that see it has seeds there.
COVERED_FRACTION = 0.3
# If a smaller share of the image cells is empty, this is a gap in the seeds and not a sky.
EMPTY_IMAGE_FRACTION = 0.04
# Smallest radius of the shell relative to the distance of far seeds.
BEHIND_SEEDS = 2.0
OVERLAP = 0.7  # standard deviation of a Gaussian relative to the spacing
# Shell colours come from shrunk images, because a direction covers many pixels.
SHELL_SHRINK = 4
SHELL_OPACITY = 0.5


@dataclass(frozen=True)
class Shell:
    """The points of a shell."""

    points: Float32[np.ndarray, "s 3"]  # positions, scene units
    scales: Float[np.ndarray, " s"]  # standard deviations, scene units
    seen: Bool[np.ndarray, "s v"]  # whether a view (by row) sees a point away from seeds
    xy: Float32[np.ndarray, "s v 2"]  # position in that view, pixels at full resolution
    empty_fraction: float  # share of image cells without seeds nearby

    def note(self) -> str:
        """Return a note about the shell and the option that turns it off."""
        return (
            f"{self.empty_fraction:.0%} of the image area shows no seed point: a far shell "
            f"of {len(self.points)} Gaussians was added (--init.shell off leaves it out)."
        )


@dataclass(frozen=True)
class Sphere:
    """The sphere of a shell."""

    middle: Float[np.ndarray, " 3"]  # scene units
    radius: float  # scene units


def sphere_behind(
    views: Sequence[View], points: Float[np.ndarray, "p 3"], radius: float, cfg: InitConfig
) -> Sphere:
    """Return the sphere of a shell, from the cameras' `radius` and the distance of far seeds."""
    middle = seeds.camera_centers(views)[~seeds.misplaced(views, points)].mean(0)
    radius *= cfg.shell_radius
    if len(points):
        far = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.98))  # without outliers
        radius = max(min(radius, 10 * far), BEHIND_SEEDS * far)
    return Sphere(middle, radius)


def _project(view: View, points: Float[np.ndarray, "p 3"], shape: tuple[int, int]):
    """Return pixel positions [p 2], flags of seen points, and (rows, columns) of their cells.

    `shape` is the number of rows and columns of cells in the image.
    """
    xy, z = project_points(points.astype(np.float64), view)
    inside = in_frame(xy, z, view.width, view.height)
    row = (xy[inside, 1] * shape[0] / view.height).astype(int)
    return xy, inside, (row, (xy[inside, 0] * shape[1] / view.width).astype(int))


def find_shell(
    views: Sequence[View],
    points: Float[np.ndarray, "p 3"],
    radius: float,
    cfg: InitConfig,
    sphere: Sphere | None = None,
) -> Shell | None:
    """Return the shell of a scene, or None if it needs none.

    The shell lies on `sphere`; None stands for `sphere_behind` the cameras, of radius `radius`.
    """
    if cfg.shell == "off":
        return None
    sphere = sphere or sphere_behind(views, points, radius, cfg)
    middle, radius = sphere.middle, sphere.radius
    directions = fibonacci_sphere(cfg.shell_count)
    candidates = middle + radius * directions
    covered = []
    for view in views:
        shape = max(1, round(CELLS_ACROSS * view.height / view.width)), CELLS_ACROSS
        cells = np.zeros(shape, np.uint8)
        cells[_project(view, points, shape)[2]] = 1
        covered.append(cv2.dilate(cells, np.ones((3, 3), np.uint8)) > 0)
    empty_fraction = float(np.mean([1 - c.mean() for c in covered]))
    if cfg.shell == "auto" and empty_fraction < EMPTY_IMAGE_FRACTION:
        return None
    seen = np.zeros((len(candidates), len(views)), bool)
    explained = np.zeros_like(seen)
    xy = np.zeros((len(candidates), len(views), 2), np.float32)
    for k, (view, cells) in enumerate(zip(views, covered, strict=True)):
        xy[:, k], seen[:, k], here = _project(view, candidates, cells.shape)
        explained[seen[:, k], k] = cells[here]
    views_seeing = seen.sum(1)
    keep = (views_seeing > 0) & (explained.sum(1) < COVERED_FRACTION * views_seeing)
    if not keep.any():
        return None
    spacing = radius * np.sqrt(4 * np.pi / cfg.shell_count)
    return Shell(
        candidates[keep].astype(np.float32),
        np.full(int(keep.sum()), OVERLAP * spacing),
        (seen & ~explained)[keep],
        xy[keep],
        empty_fraction,
    )


def shell_gaussians(
    shell: Shell,
    scene: Scene,
    store: ImageStore,
    photometry: Photometry,
    views: Sequence[View],
    cfg: FitConfig,
) -> Gaussians:
    """Return Gaussians at the points of a shell that photographs show, with their mean radiance."""

    def seen_in(view: View, row: int):
        seen = np.flatnonzero(shell.seen[:, row])
        return seen, shell.xy[seen, row]

    total, weight = np.zeros((len(shell.points), 3)), np.zeros(len(shell.points))
    for at, _, light in seeds.photographed(seen_in, scene, store, photometry, cfg, SHELL_SHRINK):
        total[at] += light
        weight[at] += 1
    seen = weight > 0
    radiance = (total[seen] / weight[seen, None]).astype(np.float32)
    start = {"scales": shell.scales[seen], "opacity": SHELL_OPACITY}
    return seeds.gaussians_from_points(shell.points[seen], radiance, views, cfg, **start)
