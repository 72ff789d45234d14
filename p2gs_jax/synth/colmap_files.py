"""A drive as a COLMAP model: cameras.bin, images.bin, points3D.bin; its points have true depth."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from p2gs_jax.core.streams import SceneStream, generator
from p2gs_jax.synth.rig import MOUNTS

_PINHOLE = 1  # COLMAP's model id
_DEPTH_TOLERANCE = 0.01  # share of the depth
_SEED_RANGE = 90.0  # m: farther points are not triangulated


class DriveViews(NamedTuple):
    """The photographs of a drive: sorted names, which begin with the folder of the camera.

    `viewmats` are world-to-camera, OpenCV axes, m. All cameras have the same K and size, in pixels,
    with pixel centres at +0.5.
    """

    names: Sequence[str]
    viewmats: Float64[np.ndarray, "v 4 4"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int


def write_seeds(
    folder: Path,
    views: DriveViews,
    xyz: Float[np.ndarray, "p 3"],
    rgb: UInt8[np.ndarray, "p 3"],
    depths: Sequence[np.ndarray],
) -> dict[str, int]:
    """Write the points that at least two views see; return counts of points and observations.

    `xyz` are world coordinates, m; `depths` hold camera z [h w] of every view, m. The format of the
    files is https://colmap.github.io/format.html.
    """
    xy, seen = _observe_seeds(xyz, views, depths)
    kept = seen.sum(0) >= 2
    xyz, rgb, xy, seen = xyz[kept], rgb[kept], xy[:, kept], seen[:, kept]
    folder.mkdir(parents=True)
    ids = {camera: i + 1 for i, camera in enumerate(MOUNTS)}
    params = (views.K[0, 0], views.K[1, 1], views.K[0, 2], views.K[1, 2])
    size = (views.width, views.height)
    data = [struct.pack("<Q", len(ids))]
    for camera_id in ids.values():
        data.append(struct.pack("<iiQQ4d", camera_id, _PINHOLE, *size, *params))
    (folder / "cameras.bin").write_bytes(b"".join(data))

    keypoint = np.dtype([("xy", "<f8", 2), ("id", "<i8")])
    data = [struct.pack("<Q", len(views.names))]
    for row, name in enumerate(views.names):
        x, y, z, w = Rotation.from_matrix(views.viewmats[row][:3, :3]).as_quat(canonical=True)
        pose = (w, x, y, z, *views.viewmats[row][:3, 3])
        visible = np.flatnonzero(seen[row])
        keypoints = np.empty(len(visible), keypoint)
        keypoints["xy"], keypoints["id"] = xy[row, visible], visible + 1
        data.append(struct.pack("<I7dI", row + 1, *pose, ids[name.split("/")[0]]))
        data.append(name.encode() + b"\0" + struct.pack("<Q", len(visible)) + keypoints.tobytes())
    (folder / "images.bin").write_bytes(b"".join(data))

    slot = np.cumsum(seen, axis=1) - 1  # the observation's place among its image's keypoints
    point_of, view_of = np.nonzero(seen.T)
    elements = np.stack([view_of + 1, slot[view_of, point_of]], axis=1).astype("<u4")
    ends = np.cumsum(seen.sum(0))
    data = [struct.pack("<Q", len(xyz))]
    for p, end in enumerate(ends):
        track = elements[(ends[p - 1] if p else 0) : end]
        data.append(struct.pack("<Q3d3Bd", p + 1, *xyz[p], *rgb[p].tolist(), 0.0))
        data.append(struct.pack("<Q", len(track)) + track.tobytes())
    (folder / "points3D.bin").write_bytes(b"".join(data))
    return {"points": len(xyz), "observations": int(seen.sum())}


def sample_seeds(
    views: DriveViews,
    photographs: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    sampled: Bool[np.ndarray, " v"],
    points: int,
    seed: int,
) -> tuple[Float64[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Return about `points` points (world, m) at random pixels of sampled views, and colours."""
    rng = generator(seed, SceneStream.SEED_POINTS)
    rows = np.flatnonzero(sampled)
    xyz, rgb = [], []
    for row in rows.tolist():
        y, x = np.nonzero(depths[row] < _SEED_RANGE)
        pick = rng.choice(len(x), min(len(x), -(-points // len(rows))), replace=False)
        x, y = x[pick], y[pick]
        ray = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).T @ np.linalg.inv(views.K).T
        local = ray * depths[row][y, x].astype(np.float64)[:, None]
        viewmat = views.viewmats[row]
        xyz.append((local - viewmat[:3, 3]) @ viewmat[:3, :3])
        rgb.append(photographs[row][y, x])
    return np.concatenate(xyz), np.concatenate(rgb)


def _observe_seeds(
    xyz: Float64[np.ndarray, "p 3"], views: DriveViews, depths: Sequence[np.ndarray]
) -> tuple[Float64[np.ndarray, "v p 2"], Bool[np.ndarray, "v p"]]:
    """Project the points into every view; return the positions and the mask of visible points.

    A point is visible if the depth interpolated from the four nearest pixel centres agrees within
    1 %. The interpolated quantity is 1 / z, which is exact on planes. Silhouettes, where the four
    pixels see different objects, are rejected.
    """
    K, width, height = views.K, views.width, views.height
    xy = np.zeros((len(views.names), len(xyz), 2))
    seen = np.zeros((len(views.names), len(xyz)), bool)
    for row, viewmat in enumerate(views.viewmats):
        local = xyz @ viewmat[:3, :3].T + viewmat[:3, 3]
        z = np.maximum(local[:, 2], 1e-3)
        xy[row] = (local[:, :2] / z[:, None]) * K[[0, 1], [0, 1]] + K[:2, 2]
        # The projection of a pixel centre may come back a rounding error outside its cell.
        u, v = np.round(xy[row].T - 0.5, 6)
        inside = (local[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        inverse = 1.0 / depths[row].astype(np.float64)
        interpolated = map_coordinates(inverse, (v, u), order=1)
        seen[row] = inside & (np.abs(interpolated * z - 1.0) < _DEPTH_TOLERANCE)
    return xy, seen
