"""Reads COLMAP's cameras, images and points3D files, binary or text, into plain records.

Why not `pycolmap.Reconstruction`: version 4.2.1 accepts a truncated `cameras.bin` without an error
and never returns from a truncated `points3D.bin`. Here every count is checked against the size of
the file. Newer models' `rigs.bin` and `frames.bin` are not needed: `images.bin` still holds every
registered image with its own pose. tests/scene/test_colmap.py compares this with pycolmap.

Format: https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from p2gs_jax.errors import UserError, broken

_FIX = "copy the model again from where it was made, or export it again from COLMAP"
_LARGEST_ID = 2**63 - 1
_STEMS = ("cameras", "images", "points3D")
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("id", "<i8")])
# Number of parameters, in the order of COLMAP's model ids.
_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}


@dataclass(frozen=True)
class CameraRecord:
    """One entry of `cameras`: COLMAP's model name, size in pixels, parameters in its order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ImageRecord:
    """One entry of `images`.

    Attributes:
        name: path relative to the image folder.
        camera_id: key into `Model.cameras`.
        qvec: world-to-camera rotation, wxyz.
        tvec: world-to-camera translation, scene units.
        xy: keypoints that have a 3D point, pixels of the photograph, centres at +0.5.
        point_ids: their points' ids.
    """

    name: str
    camera_id: int
    qvec: Float[np.ndarray, " 4"]
    tvec: Float[np.ndarray, " 3"]
    xy: Float[np.ndarray, "n 2"]
    point_ids: Int[np.ndarray, " n"]


@dataclass(frozen=True)
class Model:
    """A COLMAP model as its files state it: cameras by id, images in the file's order.

    Attributes:
        kind: suffix of its files.
        point_ids: ascending.
        xyz: scene units.
        rgb: display-encoded colours.
    """

    folder: Path
    kind: str
    cameras: dict[int, CameraRecord]
    images: tuple[ImageRecord, ...]
    point_ids: Int[np.ndarray, " p"]
    xyz: Float[np.ndarray, "p 3"]
    rgb: UInt8[np.ndarray, "p 3"]

    def file(self, stem: str) -> Path:
        """Return a file of the model, for messages."""
        return self.folder / f"{stem}.{self.kind}"


def is_model(folder: Path) -> bool:
    """Return whether the folder looks like a COLMAP model, complete or not."""
    stems = ("cameras", "points3D")
    return any((folder / f"{stem}.{ext}").is_file() for stem in stems for ext in ("bin", "txt"))


def read_model(folder: Path) -> Model:
    """Read the model in a folder; binary files win where both kinds are complete.

    Raises:
        UserError: a file is missing, truncated or malformed; the message names it.
    """
    for ext in ("bin", "txt"):
        paths = [folder / f"{stem}.{ext}" for stem in _STEMS]
        if all(path.is_file() for path in paths):
            break
    else:
        ext = "txt" if (folder / "cameras.txt").is_file() else "bin"
        paths = [folder / f"{stem}.{ext}" for stem in _STEMS]
        absent = ", ".join(str(path) for path in paths if not path.is_file())
        raise broken("incomplete COLMAP model:", f"{absent} does not exist", _FIX)
    text = (_text_cameras, _text_images, _text_points)
    binary = (_binary_cameras, _binary_images, _binary_points)
    cameras, images, points = binary if ext == "bin" else text
    ids, xyz, rgb = points(paths[2])
    order = np.argsort(ids, kind="stable")
    return Model(
        folder,
        ext,
        cameras(paths[0]),
        tuple(images(paths[1])),
        ids[order],
        xyz[order],
        rgb[order],
    )


class _Cursor:
    """A position in a binary file; reading past the end is an error."""

    def __init__(self, path: Path):
        self.path = path
        self.data = path.read_bytes()
        self.position = 0

    def unpack(self, layout: str) -> tuple:
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout)))

    def skip(self, size: int) -> int:
        """Move on by `size` bytes and return where they start."""
        start = self.position
        if start + size > len(self.data):
            raise self.cut("record")
        self.position = start + size
        return start

    def string(self) -> str:
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise self.cut("name")
        start, self.position = self.position, end + 1
        return self.data[start:end].decode("utf-8", "replace")

    def count(self, record_size: int) -> int:
        """Read a number of records that need at least `record_size` bytes each."""
        (n,) = self.unpack("<Q")
        if n * record_size > len(self.data) - self.position:
            why = f"is truncated: it announces {n} entries and has {len(self.data)} bytes in all"
            raise broken(self.path, why, _FIX)
        return n

    def cut(self, what: str) -> UserError:
        why = f"is truncated: it ends at byte {len(self.data)} in the middle of a {what}"
        return broken(self.path, why, _FIX)


def _binary_cameras(path: Path) -> dict[int, CameraRecord]:
    cursor = _Cursor(path)
    cameras = {}
    for _ in range(cursor.count(24)):
        camera_id, model_id, width, height = cursor.unpack("<iiQQ")
        if not 0 <= model_id < len(_MODELS):
            raise unsupported_camera(path, f"number {model_id}")
        model, n = list(_MODELS.items())[model_id]
        cameras[camera_id] = CameraRecord(model, width, height, cursor.unpack(f"<{n}d"))
    return cameras


def _binary_images(path: Path) -> Iterator[ImageRecord]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(73)):
        _, *pose, camera_id = cursor.unpack("<I7dI")
        name = cursor.string()
        n = cursor.count(_KEYPOINT.itemsize)
        start = cursor.skip(n * _KEYPOINT.itemsize)
        keypoints = np.frombuffer(cursor.data, _KEYPOINT, n, start)
        yield _image(name, camera_id, pose, keypoints["xy"], keypoints["id"])


def _binary_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cursor = _Cursor(path)
    n = cursor.count(51)
    ids, xyz, rgb = np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 3), np.uint8)
    for i in range(n):
        ids[i], *rest = cursor.unpack("<q3d3Bd")
        xyz[i], rgb[i] = rest[:3], rest[3:6]
        cursor.skip(8 * cursor.count(8))  # tracks: the images file has them too
    return ids, xyz, rgb


def _text_cameras(path: Path) -> dict[int, CameraRecord]:
    cameras = {}
    for number, line in _text_lines(path):
        try:
            camera_id, model, width, height, *params = line.split()
            values = tuple(map(float, params))
            cameras[int(camera_id)] = CameraRecord(model, int(width), int(height), values)
        except ValueError as error:
            raise _malformed(path, number, error) from None
        if _MODELS.get(model, len(values)) != len(values):
            raise _malformed(path, number, f"{len(values)} parameters for the model {model}")
    return cameras


def _text_images(path: Path) -> Iterator[ImageRecord]:
    lines = _text_lines(path, blank=True)
    for number, line in lines:
        if not line:
            continue
        try:
            _, *pose, camera_id, name = line.split(maxsplit=9)
            values = [float(value) for value in pose]
            if len(values) != 7:
                raise ValueError("an image line needs 10 fields")
            # An image without keypoints has an empty second line, which editors may have cut.
            number, line = next(lines, (number, ""))
            keypoints = np.array(line.split(), np.float64).reshape(-1, 3)
            record = _image(name, int(camera_id), values, keypoints[:, :2], keypoints[:, 2])
        except ValueError as error:
            raise _malformed(path, number, error) from None
        yield record


def _text_points(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    ids: list[int] = []
    xyz: list[list[float]] = []
    rgb: list[list[int]] = []
    for number, line in _text_lines(path):
        fields = line.split(maxsplit=8)
        try:
            if len(fields) < 8:
                raise ValueError("a point line needs at least 8 fields")
            ids.append(int(fields[0]))
            if abs(ids[-1]) > _LARGEST_ID:
                raise ValueError(f"{ids[-1]} is not a valid id of a point")
            xyz.append([float(value) for value in fields[1:4]])
            rgb.append([int(value) & 255 for value in fields[4:7]])
        except ValueError as error:
            raise _malformed(path, number, error) from None
    return (
        np.array(ids, np.int64),
        np.array(xyz, np.float64).reshape(-1, 3),
        np.array(rgb, np.uint8).reshape(-1, 3),
    )


def _text_lines(path: Path, *, blank: bool = False) -> Iterator[tuple[int, str]]:
    """Yield (line number, stripped line) without comments."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, raw in enumerate(file, 1):
            line = raw.strip()
            if not line.startswith("#") and (line or blank):
                yield number, line


def _image(
    name: str, camera_id: int, pose: list[float], xy: np.ndarray, ids: np.ndarray
) -> ImageRecord:
    tracked = ids >= 0
    return ImageRecord(
        name=name.replace("\\", "/"),
        camera_id=camera_id,
        qvec=np.array(pose[:4]),
        tvec=np.array(pose[4:]),
        xy=np.asarray(xy[tracked], np.float64),
        point_ids=ids[tracked].astype(np.int64),
    )


def _malformed(path: Path, line: int, what: object) -> UserError:
    return broken(path, f"is malformed in line {line}: {what}", _FIX)


def unsupported_camera(path: Path, model: str) -> UserError:
    """Return the error for a camera model that `Distortion` cannot express."""
    return broken(
        path,
        f"uses the camera model {model}; supported are PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, "
        "RADIAL, OPENCV, FULL_OPENCV, OPENCV_FISHEYE, RADIAL_FISHEYE and SIMPLE_RADIAL_FISHEYE",
        "run `colmap image_undistorter` and use the folder it writes",
    )
