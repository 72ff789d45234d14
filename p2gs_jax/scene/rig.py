"""A rig of cameras with KITTI's calibration files, and its LiDAR scans where there are any.

    calib.txt         P0, P1, ...: 3x4 projections of the cameras, in the order of their folders'
                      names; Tr_velo_to_cam0, 1, ... (or KITTI odometry's Tr): LiDAR to camera
    poses.txt         a row per frame: camera 0 to world
    lidar_poses.txt   a row per frame: LiDAR to world; without it, from poses.txt and Tr
    images/<camera>/<frame>.*     a folder per camera; the frame's number is its row in poses.txt
    velodyne/<frame>.bin          float32 x y z reflectance

Where every camera has its own Tr_velo_to_cam, those place the cameras; otherwise they are rectified
with camera 0 and displaced by the last column of their P, as in KITTI. P has pixel centres at
integers; ours are at +0.5.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.ndimage import map_coordinates

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.colmap import HUGE
from p2gs_jax.scene.files import check_missing, image_size, list_images
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.split import split_scene
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Scene, View

CALIBRATION, POSES, LIDAR_POSES, SCANS = "calib.txt", "poses.txt", "lidar_poses.txt", "velodyne"
# Scans are thinned to one point a voxel; voxels grow until at most this many points are left.
MOST_POINTS = 200_000
SMALLEST_VOXEL = 0.05
VOXEL_GROWTH = 1.3
_ROTATION_TOLERANCE = 0.01
_SINGULAR = 1e-9
# Cells of the smallest voxels up to here are numbered by 64 bits.
_FARTHEST = 5e4


def is_rig(root: Path) -> bool:
    """Return whether a folder carries KITTI's calibration and poses."""
    return (root / CALIBRATION).is_file() and (root / POSES).is_file()


def load_rig(root: Path, cfg: DataConfig) -> Scene:
    """Read a rig; without scans the scene has no points yet, and never tracks.

    Args:
        root: the folder with calib.txt and poses.txt.
        cfg: the image folder, and whether images may be missing.

    Raises:
        UserError: a file is malformed, a camera has no projection, a photograph no pose or the
            wrong size, or photographs are missing.
    """
    matrices = _read_calibration(root / CALIBRATION)
    poses = _read_poses(root / POSES)
    image_folder = root / (cfg.images or "images")
    cameras = _camera_folders(image_folder, root)
    lidar = _lidar_poses(root, poses, matrices)
    views: list[View] = []
    missing: list[str] = []
    for k, camera in enumerate(cameras):
        if f"P{k}" not in matrices:
            raise UserError(
                f"{root / CALIBRATION} has no P{k} for the camera folder {camera.name!r}",
                fix="add the projection, or remove the folder",
            )
        found = _frames_of(camera, len(poses))
        size = None
        for frame in range(len(poses)):
            path = found.get(frame)
            if path is None:
                missing.append(f"{camera.name}/{frame:06d}")
                continue
            size = size or image_size(path)
            if image_size(path) != size:
                raise UserError(
                    f"{path} has another size than the camera's first photograph "
                    f"({size[0]}x{size[1]})",
                    fix=f"give all photographs in {camera} the size that P{k} belongs to",
                )
            K, viewmat = _camera(k, frame, matrices, poses, lidar)
            name = f"{camera.name}/{path.name}"
            views.append(View(name, path, camera.name, viewmat, K, *size))
    notes = check_missing(missing, len(cameras) * len(poses), root / POSES, cfg)
    views.sort(key=lambda v: v.name)
    points = np.zeros((0, 3), np.float32)
    colors = np.zeros((0, 3), np.uint8)
    scans = sorted((root / SCANS).glob("*.bin"))
    if scans and lidar is not None:
        points, voxel = _read_scans(scans, lidar)
        without = Scene(root, "rig", tuple(views), points, None)
        points, colors, unseen = _colored(points, split_scene(without, cfg).views, cfg)
        notes.append(
            f"LiDAR: {len(scans)} scans thinned to {len(points)} points, one per {voxel:.2f} m; "
            f"{unseen} more are seen by no training view."
        )
    elif scans:
        notes.append(f"{len(scans)} LiDAR scans have no Tr_velo_to_cam0: they are not used.")
    return Scene(root, "rig", tuple(views), points, colors, None, tuple(notes))


def _camera_folders(image_folder: Path, root: Path) -> list[Path]:
    folders = (
        sorted(p for p in image_folder.iterdir() if p.is_dir()) if image_folder.is_dir() else []
    )
    folders = [p for p in folders if list_images(p, recursive=False)]
    if not folders:
        raise UserError(
            f"{root} has {CALIBRATION} and {POSES}, but {image_folder} holds no folder of "
            "photographs for any camera",
            fix="put each camera's photographs into a folder of its own there",
        )
    return folders


def _frames_of(camera: Path, count: int) -> dict[int, Path]:
    """Return the photograph of each frame, by number."""
    found: dict[int, Path] = {}
    for path in list_images(camera, recursive=False):
        if not path.stem.isdigit() or int(path.stem) >= count:
            raise UserError(
                f"{path}: its name is not the number of a row in {POSES} (0 to {count - 1})",
                fix="name photographs 000000.png, 000001.png, ... in the order of the poses",
            )
        found[int(path.stem)] = path
    return found


def _camera(
    k: int,
    frame: int,
    matrices: dict[str, Float64[np.ndarray, "3 4"]],
    poses: Float64[np.ndarray, "t 4 4"],
    lidar: Float64[np.ndarray, "t 4 4"] | None,
) -> tuple[Float32[np.ndarray, "3 3"], Float32[np.ndarray, "4 4"]]:
    """Return K (pixel centres at +0.5) and the world-to-camera matrix of one photograph."""
    P = matrices[f"P{k}"]
    K = P[:, :3].copy()
    K[:2, 2] += 0.5
    own = matrices.get(f"Tr_velo_to_cam{k}")
    if own is not None and lidar is not None:
        viewmat = _square(own) @ np.linalg.inv(lidar[frame])
    else:
        displaced = np.eye(4)
        displaced[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        viewmat = displaced @ np.linalg.inv(poses[frame])
    return K.astype(np.float32), viewmat.astype(np.float32)


def _lidar_poses(root: Path, poses, matrices) -> Float64[np.ndarray, "t 4 4"] | None:
    path = root / LIDAR_POSES
    if path.is_file():
        lidar = _read_poses(path)
        if len(lidar) != len(poses):
            raise UserError(
                f"{path} has {len(lidar)} rows where {POSES} has {len(poses)}",
                fix="write one pose for every frame into both",
            )
        return lidar
    to_first = matrices.get("Tr_velo_to_cam0", matrices.get("Tr"))
    return None if to_first is None else poses @ _square(to_first)


def _read_scans(scans: list[Path], lidar: Float64[np.ndarray, "t 4 4"]):
    """Return world points of all scans, one per voxel, and the voxel's size."""
    voxel, kept = SMALLEST_VOXEL, np.zeros((0, 3), np.float32)
    for path in scans:
        if not path.stem.isdigit() or int(path.stem) >= len(lidar):
            raise UserError(
                f"{path}: its name is not the number of a pose (0 to {len(lidar) - 1})",
                fix="name scans 000000.bin, 000001.bin, ... in the order of the poses",
            )
        values = np.fromfile(path, "<f4")
        if values.size % 4 or not (np.abs(values) < _FARTHEST).all():
            raise UserError(
                f"{path} is no LiDAR scan: float32 x y z reflectance, all finite",
                fix="write the scan again",
            )
        pose = lidar[int(path.stem)]
        local = values.reshape(-1, 4)[:, :3]
        kept = np.concatenate([kept, (local @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)])
        kept = kept[_one_per_voxel(kept, voxel)]
        while len(kept) > MOST_POINTS:
            voxel *= VOXEL_GROWTH
            kept = kept[_one_per_voxel(kept, voxel)]
    return kept, voxel


def _one_per_voxel(points: Float32[np.ndarray, "n 3"], voxel: float):
    """Return rows of the first point in every voxel."""
    cell = np.floor(points / voxel).astype(np.int64)
    cell -= cell.min(0, initial=0)
    extent = cell.max(0, initial=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])


def _colored(
    points: Float32[np.ndarray, "p 3"], views: tuple[View, ...], cfg: DataConfig
) -> tuple[Float32[np.ndarray, "q 3"], UInt8[np.ndarray, "q 3"], int]:
    """Return the points that training views see, their mean colour, and how many are unseen."""
    store = ImageStore(views, cfg)
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for index, view in enumerate(views):
        if view.split != "train":
            continue
        xy, z = project_points(points, view)
        seen = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
        ldr, _ = store.get(index, 1)
        scale = [ldr.shape[1] / view.width, ldr.shape[0] / view.height]
        at = (xy[seen] * scale - 0.5).T[::-1]
        # Not OpenCV's remap: it takes no more than 32,766 points.
        for channel in range(3):
            total[seen, channel] += map_coordinates(ldr[..., channel], at, order=1, mode="nearest")
        count[seen] += 1
    seen = count > 0
    colors = np.rint(255 * total[seen] / count[seen, None]).clip(0, 255).astype(np.uint8)
    return points[seen], colors, int((~seen).sum())


def _square(matrix: Float64[np.ndarray, "3 4"]) -> Float64[np.ndarray, "4 4"]:
    return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])


def _read_calibration(path: Path) -> dict[str, Float64[np.ndarray, "3 4"]]:
    out = {}
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        name, _, rest = line.partition(":")
        if name.strip().startswith(("P", "Tr")):
            matrix = _twelve(rest, path, number)
            if name.strip().startswith("Tr"):
                _require_rotation(matrix, path, number)
            elif not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and abs(_det(matrix)) > _SINGULAR):
                raise UserError(
                    f"{path}, line {number}: no projection of a camera",
                    fix="write 3x4 projections with positive focal lengths, as KITTI does",
                )
            out[name.strip()] = matrix
    return out


def _read_poses(path: Path) -> Float64[np.ndarray, "t 4 4"]:
    lines = path.read_text(errors="replace").splitlines()
    rows = []
    for number, line in enumerate(lines, 1):
        if line.strip():
            pose = _twelve(line, path, number)
            _require_rotation(pose, path, number)
            rows.append(_square(pose))
    if not rows:
        raise UserError(f"{path} holds no pose", fix="write one row of 12 numbers per frame")
    return np.stack(rows)


def _det(matrix: Float64[np.ndarray, "3 4"]) -> float:
    return float(np.linalg.det(matrix[:, :3]))


def _require_rotation(matrix: Float64[np.ndarray, "3 4"], path: Path, number: int) -> None:
    """Refuse a pose whose left part neither turns nor keeps lengths."""
    lengths = np.linalg.svd(matrix[:, :3], compute_uv=False)
    if np.abs(lengths - 1).max() > _ROTATION_TOLERANCE or _det(matrix) < 0:
        raise UserError(
            f"{path}, line {number}: no rotation and translation",
            fix="write 3x4 poses row by row, as KITTI does",
        )


def _twelve(text: str, path: Path, number: int) -> Float64[np.ndarray, "3 4"]:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if values.size != 12 or not (np.abs(values) < HUGE).all():
        raise UserError(
            f"{path}, line {number}: not 12 finite numbers",
            fix="write 3x4 matrices row by row, as KITTI does",
        )
    return values.reshape(3, 4)
