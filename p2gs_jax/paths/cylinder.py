"""Cylindrical images: azimuth across, height on the unit cylinder down."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.paths.geometry import Pose
from p2gs_jax.paths.shots import Shot

# Coverage is judged at this many directions per radian, up to this height (tangent of elevation).
PROBES, HIGHEST = 2 * 180 / np.pi, 3.0
# A column counts as covered from this share of the tallest column on.
FULL_COLUMN = 0.75


@dataclass(frozen=True)
class Cylinder:
    """A camera with a cylindrical image.

    Column u, row v of the image look along (sin a, h, cos a) in the camera, with a = left + u /
    focal and h = top + v / focal; pixel centres are at +0.5.

    Attributes:
        viewmat: world-to-camera; x right, y down along the axis, z towards azimuth 0.
        focal: pixels per radian, and per unit of height.
        left: azimuth of the left edge, radians, positive to the right.
        top: height of the upper edge, positive down.
        width: pixels.
        height: pixels.
    """

    viewmat: Pose
    focal: float
    left: float
    top: float
    width: int
    height: int

    @property
    def span(self) -> float:
        """Radians from the left edge to the right."""
        return self.width / self.focal

    def resized(self, width: int) -> Cylinder:
        """Return the cylinder with `width` pixels across; the height follows, rounded."""
        scale = width / self.width
        height = max(1, round(self.height * scale))
        return replace(self, focal=self.focal * scale, width=width, height=height)

    def rays(self) -> Float[np.ndarray, "h w 3"]:
        """Return world directions of all pixels, of length 1 across the axis."""
        azimuth = self.left + (np.arange(self.width) + 0.5) / self.focal
        height = self.top + (np.arange(self.height) + 0.5) / self.focal
        h, a = np.meshgrid(height, azimuth, indexing="ij")
        return np.stack([np.sin(a), h, np.cos(a)], -1) @ self.viewmat[:3, :3]


class Projected(NamedTuple):
    """Directions projected into a pinhole camera.

    Attributes:
        xy: pixels, centres at +0.5.
        cosine: of the angle from the optical axis.
        inside: whether it sees them.
    """

    xy: Float[np.ndarray, "h w 2"]
    cosine: Float[np.ndarray, "h w"]
    inside: Bool[np.ndarray, "h w"]


def project(
    shot: Shot,
    rays: Float[np.ndarray, "h w 3"],
    origin: Float[np.ndarray, " 3"] | None = None,
    nearness: Float[np.ndarray, "h w"] | None = None,
) -> Projected:
    """Return where a pinhole camera sees what lies along rays.

    Args:
        shot: the camera.
        rays: world directions.
        origin: where they start.
        nearness: 1 / distance in lengths of the rays, 0 for infinitely far; None is 0 everywhere.
    """
    R, t = shot.viewmat[:3, :3], shot.viewmat[:3, 3]
    local = rays @ R.T
    if origin is not None and nearness is not None:
        local = local + nearness[..., None] * (R @ origin + t)
    z = local[..., 2]
    front = z > 1e-9
    xy = local[..., :2] / np.where(front, z, 1.0)[..., None]
    xy = xy * shot.K[[0, 1], [0, 1]] + shot.K[:2, 2]
    inside = front & np.all((xy >= 0) & (xy <= (shot.width, shot.height)), axis=-1)
    return Projected(xy, z / np.maximum(np.linalg.norm(local, axis=-1), 1e-12), inside)


def covering(shots: Iterable[Shot], viewmat: Pose) -> Cylinder:
    """Return the cylinder that cameras cover, at the finest of their resolutions.

    From side to side it spans all cameras, less what is seen in less than three quarters of their
    height, or the full circle where they see something all around; up and down it is cut to what is
    seen in all columns that are covered. Distances between the cameras are neglected.

    Args:
        shots: the cameras.
        viewmat: of the cylinder, among them.
    """
    shots = list(shots)
    around, tall = round(2 * np.pi * PROBES), 2 * round(HIGHEST * PROBES)
    probe = Cylinder(viewmat, around / (2 * np.pi), -np.pi, -tall / 2 / PROBES, around, tall)
    rays = probe.rays()
    covered = np.any([project(shot, rays).inside for shot in shots], axis=0)
    counts = covered.sum(0)
    good = counts >= FULL_COLUMN * counts.max()
    start, count = (0, around) if counts.all() else _without_largest_gap(good)
    columns = (start + np.arange(count)) % around
    rows = covered[:, columns[good[columns]]].all(1)
    if not rows.any():
        rows = covered.any(1)
    first, last = np.flatnonzero(rows)[[0, -1]]
    focal = max(float(max(s.K[0, 0], s.K[1, 1])) for s in shots)
    # A probe stands for its surroundings: leave one out at every edge.
    cut = 0 if count == around else 1
    top = probe.top + (first + 1) / probe.focal
    bottom = probe.top + last / probe.focal
    return Cylinder(
        viewmat,
        focal,
        probe.left + (start + cut) / probe.focal,
        top,
        max(1, round((count - 2 * cut) / probe.focal * focal)),
        max(1, round((bottom - top) * focal)),
    )


def _without_largest_gap(good: Bool[np.ndarray, " n"]) -> tuple[int, int]:
    """Return begin and length of the circular range that leaves out the longest run of False."""
    there = np.flatnonzero(good)
    gaps = np.diff(np.append(there, there[0] + len(good))) - 1
    widest = int(np.argmax(gaps))
    if gaps[widest] == 0:
        return 0, len(good)
    return int(there[(widest + 1) % len(there)]), int(len(good) - gaps[widest])


def borders(source: Sequence[int] | np.ndarray) -> list[tuple[int, int, int]]:
    """Return (camera, first column, end column) of the runs of a row of `stitch`'s source map."""
    row = np.asarray(source)
    edges = np.flatnonzero(np.diff(row)) + 1
    starts, ends = np.append(0, edges), np.append(edges, len(row))
    return [(int(row[s]), int(s), int(e)) for s, e in zip(starts, ends, strict=True) if row[s] >= 0]
