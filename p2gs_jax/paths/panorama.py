"""Panoramas: pinhole images around a common centre, reprojected to a cylinder.

A wide view of the radiance field is stitched from renders of narrow slices around one centre.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.paths.shots import Pose, Shot
from p2gs_jax.scene.rigid import pose_of

# Coverage is tested at two directions per degree, up to this height (tangent of elevation).
PROBES, HIGHEST = 2 * 180 / np.pi, 3.0
# A column is good if its height is at least this share of the tallest column's.
FULL_COLUMN = 0.75
# Largest angle of a slice, radians. The affine approximation of splats errs far from the axis, but
# on both sides of the edge between narrow slices the error is nearly the same.
WIDEST_SLICE = np.deg2rad(20)

# Linear radiance [h w 3], alpha [h w] and alpha-weighted depth [h w].
Layers = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Cylinder:
    """A camera with a cylindrical image: azimuth across, height on the unit cylinder down.

    The image at (u, v), pixels, looks along (sin a, h, cos a) in the camera, with a = left +
    u / focal (radians) and h = top + v / focal; pixel centres are at +0.5. `focal` is in pixels per
    radian. `viewmat` is world-to-camera: x right, y down along the axis, z towards azimuth 0.
    """

    viewmat: Pose
    focal: float
    left: float
    top: float
    width: int
    height: int

    @property
    def span(self) -> float:
        """The angle from the left edge to the right one, radians."""
        return self.width / self.focal

    def resized(self, width: int) -> Cylinder:
        """Return the cylinder with a width of `width` pixels, and the height in proportion."""
        scale = width / self.width
        height = max(1, round(self.height * scale))
        return replace(self, focal=self.focal * scale, width=width, height=height)

    def rays(self) -> Float[np.ndarray, "h w 3"]:
        """Return world directions of all pixels, with length 1 perpendicular to the axis."""
        azimuth = self.left + (np.arange(self.width) + 0.5) / self.focal
        height = self.top + (np.arange(self.height) + 0.5) / self.focal
        h, a = np.meshgrid(height, azimuth, indexing="ij")
        return np.stack([np.sin(a), h, np.cos(a)], -1) @ self.viewmat[:3, :3]


def covering(shots: Iterable[Shot], viewmat: Pose) -> Cylinder:
    """Return the cylinder that cameras cover, at the finest of their resolutions.

    A column is good if it has three quarters of the largest height. Horizontally the cylinder
    leaves out the widest gap between good columns, or nothing if every azimuth is seen. Vertically
    it has the rows that all good columns see. Distances between the cameras are neglected.
    """
    shots = list(shots)
    around, tall = round(2 * np.pi * PROBES), 2 * round(HIGHEST * PROBES)
    probe = Cylinder(viewmat, around / (2 * np.pi), -np.pi, -tall / 2 / PROBES, around, tall)
    rays = probe.rays()
    covered = np.any([s.project(rays @ s.viewmat[:3, :3].T)[1] for s in shots], axis=0)
    counts = covered.sum(0)
    good = counts >= FULL_COLUMN * counts.max()
    start, count = 0, around
    if not (counts.all() or good.all()):
        seen = np.flatnonzero(good)
        gaps = np.diff(seen, append=seen[0] + around) - 1
        widest = int(np.argmax(gaps))
        start, count = int(seen[(widest + 1) % len(seen)]), int(around - gaps[widest])
    columns = (start + np.arange(count)) % around
    rows = covered[:, columns[good[columns]]].all(1)
    if not rows.any():
        rows = covered.any(1)
    first, last = np.flatnonzero(rows)[[0, -1]]
    focal = max(float(max(s.K[0, 0], s.K[1, 1])) for s in shots)
    # A probe represents its surroundings, so the outermost probe at every edge is left out.
    cut = 0 if count == around else 1
    top, bottom = (probe.top + row / probe.focal for row in (first + 1, last))
    left = probe.left + (start + cut) / probe.focal
    width = max(1, round((count - 2 * cut) / probe.focal * focal))
    return Cylinder(viewmat, focal, left, top, width, max(1, round((bottom - top) * focal)))


def stitch(
    images: Sequence[Float32[np.ndarray, "h w c"]], shots: Sequence[Shot], cylinder: Cylinder
) -> Float32[np.ndarray, "h w c"]:
    """Reproject images to a cylinder: each pixel from the camera that sees it closest to its axis.

    Images have at most 4 channels, and their cameras a common centre; unseen pixels are 0. Raises a
    ValueError if an image has another size than its camera.
    """
    rays = cylinder.rays()
    out = np.zeros((*rays.shape[:2], images[0].shape[2]), np.float32)
    best = np.full(rays.shape[:2], -np.inf)
    for k, (image, shot) in enumerate(zip(images, shots, strict=True)):
        if image.shape[:2] != (shot.height, shot.width):
            raise ValueError(f"image {k} has the size {image.shape[:2]}, unlike its camera")
        local = rays @ shot.viewmat[:3, :3].T
        xy, inside = shot.project(local)
        cosine = local[..., 2] / np.maximum(np.linalg.norm(local, axis=-1), 1e-12)
        better = inside & (cosine > best)
        # OpenCV has pixel centres at integers.
        x, y = np.moveaxis((xy - 0.5).astype(np.float32), -1, 0)
        values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        out[better] = values.reshape(out.shape)[better]
        best[better] = cosine[better]
    return out


def slices(cylinder: Cylinder) -> list[Shot]:
    """Return pinhole cameras of one size that together cover a cylinder from its centre.

    Their resolution equals that of the cylinder in the middle, and is finer towards the edges.
    """
    count = max(1, int(np.ceil(cylinder.span / WIDEST_SLICE)))
    half = cylinder.span / count / 2
    f = cylinder.focal
    tallest = max(abs(cylinder.top), abs(cylinder.top + cylinder.height / f))
    # One more pixel on each side is for interpolation; the principal point is in the middle.
    width = 2 * (int(np.ceil(f * np.tan(half))) + 1)
    height = 2 * (int(np.ceil(f * tallest / np.cos(half))) + 1)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    out = []
    for k in range(count):
        middle = cylinder.left + (2 * k + 1) * half
        sine, cosine = np.sin(middle), np.cos(middle)
        turn = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
        viewmat = pose_of(turn, np.zeros(3)) @ cylinder.viewmat
        out.append(Shot(f"slice_{k}", viewmat, K, width, height))
    return out


def render_wide(
    render: Callable[[Shot], Layers], cylinder: Cylinder
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """Return a wide view of the field: radiance, premultiplied by alpha, and alpha.

    `render` returns the layers of a pinhole camera.
    """
    shots = slices(cylinder)
    layers = [render(shot)[:2] for shot in shots]
    images = [np.concatenate([linear, alpha[..., None]], -1) for linear, alpha in layers]
    wide = stitch(images, shots, cylinder)
    return wide[..., :3], wide[..., 3]
