"""Small scenes made on disk, and the reprojection errors by which readers are judged."""

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.scene.rigid import pose_of
from p2gs_jax.types import Scene, View


@contextlib.contextmanager
def refused(*words: str) -> Iterator[None]:
    """Expect a UserError whose message matches the first pattern and whose text has the others."""
    with pytest.raises(UserError, match=words[0]) as info:
        yield
    for word in words[1:]:
        assert word in str(info.value)


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


def copy_model(source: Path, target: Path) -> Path:
    """Copy `sparse/0`, writable, and link the images; return the model's folder."""
    model = target / "sparse" / "0"
    model.mkdir(parents=True)
    for file in (source / "sparse" / "0").iterdir():
        shutil.copyfile(file, model / file.name)
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
        write_image(root / "images" / name, 100 + i)
        lines.append(f"{i + 1} {pose} 1 {name}\n21.25 17.5 7 3.0 3.0 -1\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text(points)
    return model


def write_image(path: Path, value: int = 100, size: tuple[int, int] = (40, 30)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(size[::-1], value, np.uint8))


def write_rgba(path: Path, value: int = 90, size: tuple[int, int] = (40, 30)) -> None:
    """Write a grey square on a transparent ground, RGBA."""
    width, height = size
    image = np.zeros((height, width, 4), np.uint8)
    image[height // 4 : -(height // 4), width // 4 : -(width // 4)] = (value, value, value, 255)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def make_view(
    path: Path, image: np.ndarray | None = None, f: float = 60.0, *, at=(0.0, 0.0, 0.0), **fields
) -> View:
    """Return a pinhole view of a file, `f` in pixels, along z; `image` is written to the file."""
    size, viewmat = fields.pop("size", (64, 48)), np.eye(4, dtype=np.float32)
    viewmat[:3, 3] -= at
    if image is not None:
        assert cv2.imwrite(str(path), image)
        size = image.shape[1::-1]
    K = np.array([[f, 0, size[0] / 2], [0, f, size[1] / 2], [0, 0, 1]], np.float32)
    return View(path.name, path, "0", viewmat, K, *size, **fields)


def around(count: int, distance: float = 4.0) -> np.ndarray:
    """Return OpenGL camera-to-world poses on a ring, 30 degrees up, that look at the origin."""
    poses = []
    for angle in 2 * np.pi * np.arange(count) / count:
        back = np.array([0.866 * np.cos(angle), 0.866 * np.sin(angle), 0.5])
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        poses.append(pose_of(np.stack([right, np.cross(back, right), back], 1), distance * back))
    return np.stack(poses)


def blender(poses: np.ndarray, part: str, angle: float = 0.7) -> dict:
    """Return the .json of a part of the split, as NeRF's synthetic scenes have it."""
    frames = [
        {"file_path": f"./{part}/r_{k}", "rotation": 0.01, "transform_matrix": pose.tolist()}
        for k, pose in enumerate(poses)
    ]
    return {"camera_angle_x": angle, "frames": frames}


def write_blender(root: Path, write=write_rgba, **counts: int) -> Path:
    """Write such a scene of cameras around the origin; `write` gets each photograph's path."""
    for part, count in {"train": 6, "test": 3, "val": 0, **counts}.items():
        if count:
            (root / part).mkdir(parents=True, exist_ok=True)
            (root / f"transforms_{part}.json").write_text(json.dumps(blender(around(count), part)))
        for k in range(count):
            write(root / part / f"r_{k}.png")
    return root


class Malicious:
    """An object whose unpickling calls a function with arguments."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call
