"""A drive as a COLMAP model: cameras.bin, images.bin, points3D.bin."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from scipy.spatial.transform import Rotation

from p2gs_jax.synth.rig import MOUNTS

_PINHOLE = 1  # COLMAP's model id


class DriveViews(NamedTuple):
    """The photographs of a drive.

    Attributes:
        names: relative to the image folder, sorted.
        cameras: physical camera of each.
        viewmats: world-to-camera, OpenCV axes, m.
        K: intrinsics of all cameras, pixels, centres at +0.5.
        width: pixels.
        height: pixels.
    """

    names: Sequence[str]
    cameras: Sequence[str]
    viewmats: Float64[np.ndarray, "v 4 4"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int


def write_colmap(
    folder: Path,
    views: DriveViews,
    xyz: Float[np.ndarray, "p 3"],
    rgb: UInt8[np.ndarray, "p 3"],
    xy: Float[np.ndarray, "v p 2"],
    seen: Bool[np.ndarray, "v p"],
) -> None:
    """Write cameras.bin, images.bin, points3D.bin (https://colmap.github.io/format.html)."""
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
        which = np.flatnonzero(seen[row])
        keypoints = np.empty(len(which), keypoint)
        keypoints["xy"], keypoints["id"] = xy[row, which], which + 1
        data.append(struct.pack("<I7dI", row + 1, *pose, ids[views.cameras[row]]))
        data.append(name.encode() + b"\0" + struct.pack("<Q", len(which)) + keypoints.tobytes())
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
