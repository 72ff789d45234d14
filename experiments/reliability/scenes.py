"""Small whole scenes, to be broken: a handful of photographs of noise in every format."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from reliability.mutations import Field, packed

WIDTH, HEIGHT, VIEWS, POINTS = 48, 32, 4, 12
FOCAL = 40.0


def names() -> list[str]:
    """Return the names of the photographs."""
    return [f"{k:06d}.png" for k in range(VIEWS)]


def _xyz() -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.column_stack([rng.uniform(-1, 1, (POINTS, 2)), rng.uniform(3, 5, POINTS)])


def _shift(view: int) -> float:
    return 0.2 * view


def write_photographs(folder: Path) -> None:
    """Write photographs of noise."""
    rng = np.random.default_rng(1)
    folder.mkdir(parents=True, exist_ok=True)
    for name in names():
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        # Not imwrite: OpenCV 4.13 ends the process at a path that is not UTF-8.
        (folder / name).write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def camera_fields() -> list[Field]:
    """Return COLMAP's cameras.bin."""
    values = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    return [
        Field("<Q", 1, "number of cameras"),
        Field("<i", 1, "camera id"),
        Field("<i", 1, "model id"),
        Field("<Q", WIDTH, "width"),
        Field("<Q", HEIGHT, "height"),
        *(Field("<d", v, n) for v, n in zip(values, ("fx", "fy", "cx", "cy"), strict=True)),
    ]


def image_fields(views: int = VIEWS) -> list[Field]:
    """Return COLMAP's images.bin."""
    fields = [Field("<Q", views, "number of images")]
    for view, name in enumerate(names()[:views]):
        pose = (1.0, 0.0, 0.0, 0.0, -_shift(view), 0.0, 0.0)
        fields += [Field("<I", view + 1, "image id")]
        fields += [Field("<d", v, n) for v, n in zip(pose, "wxyzXYZ", strict=True)]
        fields += [Field("<I", 1, "camera id"), Field("", name.encode() + b"\0", "name")]
        fields += [Field("<Q", POINTS, "number of keypoints")]
        for point, (x, y) in enumerate(_observed(view)):
            fields += [Field("<d", x, "x"), Field("<d", y, "y"), Field("<q", point + 1, "point id")]
    return fields


def point_fields() -> list[Field]:
    """Return COLMAP's points3D.bin."""
    fields = [Field("<Q", POINTS, "number of points")]
    for point, xyz in enumerate(_xyz()):
        fields += [Field("<Q", point + 1, "point id"), *(Field("<d", v, "x") for v in xyz)]
        fields += [Field("<B", 100 + point, "colour") for _ in range(3)]
        fields += [Field("<d", 0.5, "error"), Field("<Q", VIEWS, "number of observations")]
        for view in range(VIEWS):
            fields += [Field("<I", view + 1, "image id"), Field("<I", point, "keypoint")]
    return fields


def _observed(view: int) -> np.ndarray:
    xyz = _xyz() - [_shift(view), 0, 0]
    return FOCAL * xyz[:, :2] / xyz[:, 2:] + [WIDTH / 2, HEIGHT / 2]


def write_colmap(root: Path, text: bool = False) -> Path:
    """Write a COLMAP model; return the folder of it."""
    write_photographs(root / "images")
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    if not text:
        (model / "cameras.bin").write_bytes(packed(camera_fields()))
        (model / "images.bin").write_bytes(packed(image_fields()))
        (model / "points3D.bin").write_bytes(packed(point_fields()))
        return model
    for name, written in colmap_text().items():
        (model / name).write_text(written)
    return model


def colmap_text() -> dict[str, str]:
    """Return the files of COLMAP's text model."""
    camera = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    images = ""
    for view, name in enumerate(names()):
        keypoints = " ".join(f"{x:.3f} {y:.3f} {k + 1}" for k, (x, y) in enumerate(_observed(view)))
        images += f"{view + 1} 1 0 0 0 {-_shift(view)} 0 0 1 {name}\n{keypoints}\n"
    points = "".join(
        f"{k + 1} {x:.4f} {y:.4f} {z:.4f} 90 100 110 0.5 "
        + " ".join(f"{v + 1} {k}" for v in range(VIEWS))
        + "\n"
        for k, (x, y, z) in enumerate(_xyz())
    )
    return {"cameras.txt": "# cameras\n" + camera, "images.txt": images, "points3D.txt": points}


def transforms() -> dict:
    """Return nerfstudio's transforms.json."""
    frames = []
    for view, name in enumerate(names()):
        matrix = np.diag([1.0, -1.0, -1.0, 1.0])
        matrix[0, 3] = _shift(view)
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    return {
        "camera_model": "OPENCV",
        "w": WIDTH,
        "h": HEIGHT,
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        "k1": 0.01,
        "train_filenames": [f"images/{n}" for n in names()[1:]],
        "test_filenames": [f"images/{names()[0]}"],
        "ply_file_path": "points.ply",
        "frames": frames,
    }


def ply() -> str:
    """Return seed points."""
    rows = "".join(f"{x:.4f} {y:.4f} {z:.4f} 90 100 110\n" for x, y, z in _xyz())
    properties = "".join(f"property float {a}\n" for a in "xyz")
    properties += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    return f"ply\nformat ascii 1.0\nelement vertex {POINTS}\n{properties}end_header\n{rows}"


def write_transforms(root: Path) -> None:
    """Write a scene with a transforms.json and seed points."""
    write_photographs(root / "images")
    (root / "transforms.json").write_text(json.dumps(transforms()))
    (root / "points.ply").write_text(ply())
