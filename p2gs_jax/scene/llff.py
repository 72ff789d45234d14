"""LLFF's `poses_bounds.npy`: a row a photograph, in the order of the photographs' names.

A row is a 3x5 matrix, row by row, and the nearest and the farthest depth. The matrix is the
camera-to-world pose with the axes (down, right, backwards), and beside it height, width and focal
length in pixels (github.com/Fyusion/LLFF, "Using your own poses").
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import BROKEN_ARRAYS
from p2gs_jax.errors import UserError
from p2gs_jax.scene.files import check_size, list_images
from p2gs_jax.scene.geometry import intrinsics, scale_intrinsics
from p2gs_jax.types import Scene, View

FILE = "poses_bounds.npy"
COLUMNS = 17
# Columns of LLFF's rotation that are OpenCV's x, y, z, and their signs: right, down, forward.
_AXES, _SIGNS = [1, 0, 2], np.array([1.0, 1.0, -1.0])
_FIX = "write it again with LLFF's imgs2poses.py, or remove it"


def is_llff(root: Path) -> bool:
    """Return whether a folder carries LLFF's poses."""
    return (root / FILE).is_file()


def load_llff(root: Path, cfg: DataConfig) -> Scene:
    """Read poses, intrinsics and bounds; the scene has no points and no tracks yet.

    Args:
        root: the folder with poses_bounds.npy.
        cfg: the image folder, such as `images_4`.

    Raises:
        UserError: the file is broken, has not a row for each photograph, or photographs have
            another shape than it says.
    """
    path = root / FILE
    rows = _read(path)
    folder = root / (cfg.images or "images")
    photographs = list_images(folder, recursive=False)
    if len(photographs) != len(rows):
        raise UserError(
            f"{path} has {len(rows)} rows, and {folder} holds {len(photographs)} photographs",
            fix="put all photographs of the poses there and no others, or name their folder with "
            "--images",
        )
    views, resized = [], 0
    for k, (image, row) in enumerate(zip(photographs, rows, strict=True)):
        matrix = row[:15].reshape(3, 5)
        height, width, focal = matrix[:, 4]
        if not (min(height, width) >= 1 and focal > 0):
            raise UserError(
                f"{path}: row {k} has an impossible height, width or focal length", fix=_FIX
            )
        w, h, sx, sy, differs = check_size(image, round(width), round(height), path)
        resized += differs
        K = intrinsics(focal, focal, width / 2, height / 2)
        views.append(
            View(
                name=image.name,
                image_path=image,
                camera="0",
                viewmat=_viewmat(matrix, path, k),
                K=scale_intrinsics(K, sx, sy).astype(np.float32),
                width=w,
                height=h,
            )
        )
    notes = (
        [f"{resized} images have another size than {FILE} says: intrinsics were rescaled"]
        if resized
        else []
    )
    return Scene(
        root=root,
        format="llff",
        views=tuple(views),
        points=np.zeros((0, 3), np.float32),
        point_colors=np.zeros((0, 3), np.uint8),
        notes=tuple(notes),
        depths=(float(rows[:, 15].min()), float(rows[:, 16].max())),
    )


def _read(path: Path) -> Float64[np.ndarray, "v 17"]:
    """Return the table; nothing in the file is run."""
    try:
        table = np.load(path, allow_pickle=False)
    except BROKEN_ARRAYS as error:
        raise UserError(f"{path} cannot be read: {error}", fix=_FIX) from None
    if not isinstance(table, np.ndarray) or table.dtype.kind not in "fiu":
        raise UserError(f"{path} holds no numbers", fix=_FIX)
    if table.ndim != 2 or table.shape[1] != COLUMNS or not len(table):
        shape = "x".join(map(str, table.shape))
        raise UserError(f"{path} holds {shape} numbers, not N x {COLUMNS}", fix=_FIX)
    table = table.astype(np.float64)
    for k, row in enumerate(table):
        if not np.isfinite(row[:15]).all():
            raise UserError(f"{path}: the pose in row {k} is not finite", fix=_FIX)
        near, far = row[15:]
        if not (np.isfinite([near, far]).all() and 0 < near < far):
            raise UserError(f"{path}: row {k} has impossible bounds: {near:g} to {far:g}", fix=_FIX)
    return table


def _viewmat(matrix: Float64[np.ndarray, "3 5"], path: Path, row: int):
    """Return the OpenCV world-to-camera matrix of a camera-to-world one in LLFF's axes."""
    u, s, vt = np.linalg.svd(matrix[:, _AXES] * _SIGNS)
    if np.abs(s - 1.0).max() > 0.01 or np.linalg.det(u @ vt) < 0:
        raise UserError(f"{path}: row {row} is no rotation and translation", fix=_FIX)
    viewmat = np.eye(4)
    viewmat[:3, :3] = (u @ vt).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ matrix[:, 3]
    return viewmat.astype(np.float32)
