"""Small scenes made on disk, and the one measure every reader is held to."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from p2gs_jax.types import Scene


def reprojection_errors(scene: Scene) -> np.ndarray:
    """Return the error in pixels of every observation."""
    tracks = scene.tracks
    assert tracks is not None
    viewmats = np.stack([v.viewmat for v in scene.views]).astype(np.float64)[tracks.view_indices]
    Ks = np.stack([v.K for v in scene.views]).astype(np.float64)[tracks.view_indices]
    points = scene.points[tracks.point_indices].astype(np.float64)
    cam = np.einsum("nij,nj->ni", viewmats[:, :3, :3], points) + viewmats[:, :3, 3]
    assert (cam[:, 2] > 0).mean() > 0.999
    image = np.einsum("nij,nj->ni", Ks, cam)
    return np.linalg.norm(image[:, :2] / image[:, 2:] - tracks.xy, axis=1)


def copy_model(source: Path, target: Path, *, text: bool = False) -> Path:
    """Copy `sparse/0` and link the images, writable; return the model's folder."""
    model = target / "sparse" / "0"
    model.mkdir(parents=True)
    if text:
        pycolmap.Reconstruction(source / "sparse" / "0").write_text(model)
    else:
        for file in (source / "sparse" / "0").iterdir():
            shutil.copyfile(file, model / file.name)
    if not (target / "images").exists():
        (target / "images").symlink_to(source / "images")
    return model


def write_tiny_model(
    root: Path,
    *,
    cameras: str = "1 PINHOLE 40 30 50 50 20 15\n",
    pose: str = "1 0 0 0 0 0 0",
    points: str = "7 0.1 0.2 4 10 20 30 0.5 1 0 2 0\n",
    n: int = 2,
) -> Path:
    """Write a text model of n grey images 40x30 that all see one point."""
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (root / "images").mkdir()
    (model / "cameras.txt").write_text("# a comment\n" + cameras)
    lines = []
    for i in range(n):
        name = f"im {i}.png"
        cv2.imwrite(str(root / "images" / name), np.full((30, 40), 100 + i, np.uint8))
        lines.append(f"{i + 1} {pose} 1 {name}\n21.25 17.5 7 3.0 3.0 -1\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text(points)
    return model
