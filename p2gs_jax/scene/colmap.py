"""A COLMAP model, binary or text, and its photographs as a Scene.

This reader replaces `pycolmap.Reconstruction`: version 4.2.1 accepts a truncated `cameras.bin` and
never returns from a truncated `points3D.bin`. Here every count is checked against the size of the
file. `rigs.bin` and `frames.bin` of newer models are not needed: `images.bin` holds the pose of
every registered image. Format: https://colmap.github.io/format.html
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import count_of, first_few
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene import files
from p2gs_jax.scene.cameras import name_cameras
from p2gs_jax.scene.lens import COLMAP_LENSES, intrinsics, make_distortion, undistort_points
from p2gs_jax.scene.rigid import off_origin, pose_of
from p2gs_jax.scene.seeds import read_points
from p2gs_jax.types import ColmapLens, Distortion, Scene, Tracks, View

_FIX = "export the model again from COLMAP"
_FIX_FILES = "copy the model again from where it was made, or export it again from COLMAP"
CUT = (
    "cut the panoramas into pinhole photographs: ns-process-data images --camera-type "
    "equirectangular, or COLMAP's python/examples/panorama_sfm.py"
)
_LENGTH = struct.Struct("<Q")
_NUMBERS = re.compile(r"[-+.\deEnaif\s]*")  # `nan` and `inf` included
_STEMS = ("cameras", "images", "points3D")
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3)])
# Bytes of a point up to its observations, and the position of their number, behind the error.
_POINT_BYTES, _LENGTH_AT = 51, 43
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("id", "<i8")])
IMAGE_FOLDERS = ("images", "input", "input_images")
"""Folders of photographs beside a model, as nerfstudio, 3DGS and HDR-NeRF name them."""
# Numbers of parameters, and of focal lengths among these, in the order of COLMAP's model ids. A
# model with 0 focal lengths is not supported.
_MODELS = {
    "SIMPLE_PINHOLE": (3, 1),
    "PINHOLE": (4, 2),
    "SIMPLE_RADIAL": (4, 1),
    "RADIAL": (5, 1),
    "OPENCV": (8, 2),
    "OPENCV_FISHEYE": (8, 2),
    "FULL_OPENCV": (12, 2),
    "FOV": (5, 2),
    "SIMPLE_RADIAL_FISHEYE": (4, 1),
    "RADIAL_FISHEYE": (5, 1),
    "THIN_PRISM_FISHEYE": (12, 2),
    "RAD_TAN_THIN_PRISM_FISHEYE": (16, 2),
    "SIMPLE_DIVISION": (4, 1),
    "DIVISION": (5, 2),
    "SIMPLE_FISHEYE": (3, 1),
    "FISHEYE": (4, 2),
    "EUCM": (6, 2),
    "EQUIRECTANGULAR": (2, 0),
}


def find_model(root: Path) -> Path | None:
    """Return the folder of a scene's COLMAP model, or None.

    It is `sparse/0`, `sparse`, the root, or a folder below `sparse`. Numbered models are parts that
    COLMAP could not join; the part with most photographs is used. Raises UserError: folders below
    `sparse` hold several models that are not such parts.
    """
    usual = (root / "sparse" / "0", root / "sparse", root)
    return _largest(next((f for f in usual if is_model(f)), None) or _first_below(root / "sparse"))


def find_deeper_model(root: Path) -> Path | None:
    """Return a model up to four folders below a scene, such as `colmap/sparse/0`, or None.

    Raises UserError: there are several that are not numbered parts of one, as of several scenes.
    """
    return _largest(_first_below(root))


def _first_below(root: Path) -> Path | None:
    for depth in range(1, 5):
        images = (f for f in root.glob("*/" * depth + "images.*") if f.suffix in (".bin", ".txt"))
        folders = {f.parent for f in images if f.with_stem("cameras").is_file()}
        found = [folder for folder in folders if not _is_of_run(folder, root)]
        # 3DGS keeps the original of an undistorted model in a folder of this name.
        found = [f for f in found if "distorted" not in f.relative_to(root).parts] or found
        apart = sorted({str(f.parent if f.name.isdecimal() else f) for f in found})
        if len(apart) > 1:
            why = f"holds several COLMAP models: {first_few(apart)}"
            raise broken(root, why, "name the folder of one scene, or that of its model")
        if found:
            return min(found)
    return None


def _is_of_run(folder: Path, root: Path) -> bool:
    """Return whether a model belongs to a run folder, which may lie below its scene."""
    above = {*folder.parents} - {root, *root.parents}
    kept = "cache" in folder.relative_to(root).parts
    return kept or any((place / "photometry.json").exists() for place in above)


def _largest(folder: Path | None) -> Path | None:
    """Return the model with most photographs among the numbered ones in the same folder."""
    if folder is None or not folder.name.isdecimal():
        return folder
    beside = [f for f in folder.parent.iterdir() if f.name.isdecimal() and is_model(f)]
    return max(beside, key=lambda f: (_count(f), f == folder))


def _count(folder: Path) -> int:
    """Return the approximate number of photographs in a model, without reading it."""
    path = folder / "images.bin"
    if path.is_file():
        with path.open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    path = folder / "images.txt"
    return sum(1 for _ in _text_lines(path, blank=True)) // 2 if path.is_file() else 0


def load_colmap(root: Path, folder: Path, cfg: DataConfig) -> Scene:
    """Read the COLMAP model in a folder; views have no split, masks or EXIF yet.

    Raises UserError: a file is broken, images are missing or have another aspect ratio, the lens
    is not supported, or the model is empty.
    """
    model = read_model(folder)
    _check_model(model)
    images = sorted(model.images, key=lambda image: image.name)
    place = files.image_folder(root, cfg)
    source, inside = model.file("images"), place or root / "images"
    for image in images:  # before any of these files is opened
        files.require_inside(PurePosixPath(image.name), inside, source)
    place = place or _find_images(root, model)
    found = files.find_names([image.name for image in images], place)
    missing = [image.name for image in images if image.name not in found]
    notes = files.check_missing(missing, len(images), source, cfg, place)
    notes += files.nearly_named(found, source.name)
    images = [i._replace(name=found[i.name]) for i in images if i.name in found]
    images.sort(key=lambda image: image.name)
    model = model._replace(images=images)
    views, resized = [], 0
    for image in images:
        camera, path = model.cameras[image.camera_id], place / image.name
        K, distortion = _lens(model.file("cameras"), camera)
        size = (camera.width, camera.height)
        K, width, height = files.at_file_size(path, K, size, model.file("cameras"))
        resized += (width, height) != size
        finite = (np.abs([*image.qvec, *image.tvec]) < files.HUGE).all()
        norm = np.linalg.norm(image.qvec) if finite else 0.0
        if norm < 1e-6:
            raise broken(f"{source}:", f"the pose of {image.name} is not finite", _FIX)
        rotation = Rotation.from_quat(np.roll(image.qvec / norm, -1)).as_matrix()
        viewmat = pose_of(rotation, image.tvec)
        number = str(image.camera_id)
        views.append(View(image.name, path, number, viewmat, K, width, height, distortion))
    notes += files.rescaled(resized, model.file("cameras").name)
    others = sorted(p.name for p in folder.parent.iterdir() if p != folder and is_model(p))
    if folder.name.isdecimal() and others:
        used = f"used the model {folder} with {len(model.images)} photographs, the largest"
        notes.append(f"{used}; the models beside it ({', '.join(others)}) are not used")
    tracks = tracks_of(model, views)
    seen = np.concatenate([image.point_ids for image in model.images])
    lost = int((~np.isin(seen, model.point_ids)).sum())
    if lost and (model.point_ids >= 0).any():
        why = f"{count_of(lost, 'observation')} in {source.name} are left out: "
        notes.append(f"{why}{model.file('points3D').name} lacks their points")
    known = len(seen) - lost
    if tracks is not None and len(tracks.xy) < known / 2:
        note = f"only {len(tracks.xy):,} of {count_of(known, 'observation')} lie where the lenses "
        notes.append(f"{note}in {model.file('cameras')} are valid: check their distortion")
    named = name_cameras(views, cfg.camera_by)
    return off_origin(Scene(root, "colmap", named, model.xyz, model.rgb, tracks, tuple(notes)))


def tracks_of(model: Model, views: Sequence[View]) -> Tracks | None:
    """Return observations of the model's points, in undistorted pixels of the views, or None.

    Views are matched by name; keypoints are scaled to the view's size. Keypoints of other images,
    of points that the model lacks (some tools thin points3D) and outside a pinhole are left out.
    """
    if not (model.point_ids >= 0).any():
        return None
    rows = {view.name: i for i, view in enumerate(views)}
    view_rows, point_rows, positions = [], [], []
    for image in sorted(model.images, key=lambda image: image.name):
        row = rows.get(image.name)
        if row is None or len(image.point_ids) == 0:
            continue
        view, camera = views[row], model.cameras[image.camera_id]
        at = np.searchsorted(model.point_ids, image.point_ids).clip(max=len(model.point_ids) - 1)
        usable = (model.point_ids[at] == image.point_ids) & (np.abs(image.xy) < files.HUGE).all(1)
        scale = (view.width / camera.width, view.height / camera.height)
        xy = undistort_points(image.xy[usable] * scale, view.K, view.distortion)
        # Points at the sides of a wide lens are outside every pinhole image.
        inside = np.isfinite(xy).all(axis=1)
        positions.append(xy[inside])
        point_rows.append(at[usable][inside])
        view_rows.append(np.full(int(inside.sum()), row))
    if not positions:
        return None
    seen_in, seen_points = (np.concatenate(at).astype(np.int32) for at in (view_rows, point_rows))
    return Tracks(seen_in, seen_points, np.concatenate(positions))


def _check_model(model: Model) -> None:
    if not model.cameras:
        raise broken(model.file("cameras"), "holds no cameras", _FIX)
    if not model.images:
        fix = "COLMAP's mapping found nothing; run it again on these photographs"
        raise broken(model.file("images"), "holds no registered images", fix)
    ((name, most),) = Counter(image.name for image in model.images).most_common(1)
    if most > 1:
        raise broken(model.file("images"), f"lists {name} more than once", _FIX)
    for image in model.images:
        if image.camera_id not in model.cameras:
            why = f"{image.name} has camera {image.camera_id}, which is not in "
            why += f"{model.file('cameras')}"
            raise broken(f"{model.file('images')}:", why, _FIX)
    twice = model.point_ids[1:][np.diff(model.point_ids) == 0]
    if twice.max(initial=-1) >= 0:  # the points of a PLY have no ids
        raise broken(model.file("points3D"), f"lists point {twice.max()} more than once", _FIX)
    bad = int((~(np.abs(model.xyz) < files.HUGE).all(axis=1)).sum())
    if bad:
        why = f"{bad} of {len(model.xyz)} points are not finite"
        raise broken(f"{model.file('points3D')}:", why, _FIX)


def _find_images(root: Path, model: Model) -> Path:
    """Return the nearest folder with photographs of the model, if possible at the model's size."""
    above = [f for f in (model.folder, *model.folder.parents) if f.is_relative_to(root)]
    above += [f for f in list(root.parents)[:2] if model.folder == root]
    places = [f / name for f in above for name in IMAGE_FOLDERS if (f / name).is_dir()]
    candidates = []
    for place in [*places, root]:
        image = next((i for i in model.images if (place / i.name).is_file()), None)
        if image is not None:
            camera = model.cameras[image.camera_id]
            same = files.image_size(place / image.name) == (camera.width, camera.height)
            candidates.append((not same, len(candidates), place))
    if candidates:
        return min(candidates)[2]
    if places:
        return places[-1]
    looked = ", ".join(str(f / "images") for f in above)
    why = f"has no image folder: looked for {looked}"
    raise broken(f"the COLMAP model {model.folder}", why, "name the folder with --images")


def _lens(path: Path, camera: CameraRecord) -> tuple[Float[np.ndarray, "3 3"], Distortion | None]:
    """Return K and distortion; terms of OpenCV's lenses that the model lacks are 0."""
    focals, p = _MODELS.get(camera.model, (0, 0))[1], camera.params
    if not focals:
        raise _unsupported(path, camera.model)
    fx, fy, (cx, cy) = p[0], p[focals - 1], p[focals : focals + 2]
    if not ((np.abs(p) < files.HUGE).all() and min(fx, fy, camera.width, camera.height) > 0):
        why = f"a {camera.model} camera of {camera.width}x{camera.height} pixels has "
        raise broken(f"{path}:", f"{why}impossible parameters {p}", _FIX)
    K, terms = intrinsics(fx, fy, cx, cy), p[focals + 2 :]
    lens = camera.model.removeprefix("SIMPLE_")
    if lens in COLMAP_LENSES:
        return K, make_distortion(terms, cast(ColmapLens, lens))
    model = "fisheye" if "FISHEYE" in camera.model else "radial"
    return K, make_distortion((*terms, *[0.0] * (4 - len(terms))), model)


class CameraRecord(NamedTuple):
    """One entry of `cameras`: model name, size in pixels, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ImageRecord(NamedTuple):
    """One entry of `images`; its pose is world-to-camera."""

    name: str  # relative to the image folder
    camera_id: int
    qvec: Float[np.ndarray, " 4"]  # wxyz
    tvec: Float[np.ndarray, " 3"]  # scene units
    xy: Float[np.ndarray, "n 2"]  # keypoints with a 3D point, in pixels with centres at +0.5
    point_ids: Int[np.ndarray, " n"]  # ids of these points


class Model(NamedTuple):
    """A COLMAP model."""

    folder: Path
    kind: str  # bin or txt
    cameras: dict[int, CameraRecord]  # by id
    images: tuple[ImageRecord, ...]  # in the file's order
    point_ids: Int[np.ndarray, " p"]  # ascending; points of a PLY have id -1
    xyz: Float[np.ndarray, "p 3"]  # scene units
    rgb: UInt8[np.ndarray, "p 3"] | None  # display-encoded

    def file(self, stem: str) -> Path:
        """Return a file of the model, for messages."""
        return self.folder / f"{stem}.{self.kind}"


def is_model(folder: Path) -> bool:
    """Return whether the folder looks like a COLMAP model, complete or not."""
    stems = ("cameras", "points3D")
    return any((folder / f"{stem}.{ext}").is_file() for stem in stems for ext in ("bin", "txt"))


def read_model(folder: Path) -> Model:
    """Read the model in a folder; binary files are preferred if both kinds are complete.

    Points may be absent, or in 3DGS's points3D.ply. Raises UserError: another file is missing, or
    a file is truncated or malformed; the message names it.
    """
    parts = {ext: [folder / f"{stem}.{ext}" for stem in _STEMS] for ext in ("bin", "txt")}
    absent = {ext: [p for p in paths if not p.is_file()] for ext, paths in parts.items()}
    every = [*parts["bin"], *parts["txt"]]
    not_file = next((path for path in every if path.exists() and not path.is_file()), None)
    if not_file is not None:
        raise broken(not_file, "is not a file", _FIX_FILES)
    complete = [ext for ext in parts if {*absent[ext]} <= {parts[ext][2]}]
    if not complete:
        ext = min(absent, key=lambda ext: len(absent[ext]))
        why = f"{', '.join(map(str, absent[ext]))} does not exist"
        raise broken("incomplete COLMAP model:", why, _FIX_FILES)
    ext = min(complete, key=lambda ext: len(absent[ext]))
    cameras, images, points = parts[ext]
    text = (_text_cameras, _text_images, _text_points)
    binary = (_binary_cameras, _binary_images, _binary_points)
    read_cameras, read_images, read_points3d = binary if ext == "bin" else text
    if points.is_file():
        rows = read_points3d(points)
        rows = rows[np.argsort(rows["id"], kind="stable")]
        ids, xyz, rgb = (np.ascontiguousarray(rows[name]) for name in ("id", "xyz", "rgb"))
    elif (folder / "points3D.ply").is_file():
        xyz, rgb = read_points(folder / "points3D.ply")
        ids = np.full(len(xyz), -1)
    else:
        ids, xyz, rgb = np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    by_id: dict[int, CameraRecord] = {}
    for camera_id, record in read_cameras(cameras):
        if camera_id in by_id:
            raise broken(cameras, f"lists camera {camera_id} more than once", _FIX)
        by_id[camera_id] = record
    return Model(folder, ext, by_id, tuple(read_images(images)), ids, xyz, rgb)


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
            why = f"is truncated: it announces {n} entries but has only {len(self.data)} bytes"
            raise broken(self.path, why, _FIX_FILES)
        return n

    def cut(self, what: str) -> UserError:
        why = f"is truncated: it ends at byte {len(self.data)} in the middle of a {what}"
        return broken(self.path, why, _FIX_FILES)


def _binary_cameras(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(24)):
        camera_id, model_id, width, height = cursor.unpack("<iiQQ")
        if not 0 <= model_id < len(_MODELS):
            raise _unsupported(path, f"number {model_id}")
        model, (n, _) = list(_MODELS.items())[model_id]
        yield camera_id, CameraRecord(model, width, height, cursor.unpack(f"<{n}d"))


def _binary_images(path: Path) -> Iterator[ImageRecord]:
    cursor = _Cursor(path)
    for _ in range(cursor.count(73)):
        _, *pose, camera_id = cursor.unpack("<I7dI")
        name = cursor.string()
        n = cursor.count(_KEYPOINT.itemsize)
        start = cursor.skip(n * _KEYPOINT.itemsize)
        keypoints = np.frombuffer(cursor.data, _KEYPOINT, n, start)
        yield _image(name, camera_id, pose, keypoints["xy"], keypoints["id"])


def _binary_points(path: Path) -> np.ndarray:
    cursor = _Cursor(path)
    starts = np.empty(cursor.count(_POINT_BYTES), np.int64)
    for k in range(len(starts)):
        start = starts[k] = cursor.skip(_POINT_BYTES)
        (length,) = _LENGTH.unpack_from(cursor.data, start + _LENGTH_AT)
        cursor.skip(8 * length)  # tracks: the images file has them too
    records = np.frombuffer(cursor.data, np.uint8)[starts[:, None] + np.arange(_POINT.itemsize)]
    return records.view(_POINT)[:, 0]


@contextmanager
def _parsing(path: Path, line: int) -> Iterator[None]:
    try:
        yield
    except (ValueError, OverflowError) as error:
        raise broken(path, f"is malformed in line {line}: {error}", _FIX_FILES) from None


def _text_cameras(path: Path) -> Iterator[tuple[int, CameraRecord]]:
    for number, line in _text_lines(path):
        with _parsing(path, number):
            camera_id, model, width, height, *params = line.split()
            values = tuple(map(float, params))
            record = int(camera_id), CameraRecord(model, int(width), int(height), values)
            if _MODELS.get(model, (len(values),))[0] != len(values):
                raise ValueError(f"{len(values)} parameters for the model {model}")
        yield record


def _text_images(path: Path) -> Iterator[ImageRecord]:
    lines = _text_lines(path, blank=True)
    following = next(lines, None)
    while following is not None:
        (number, line), following = following, next(lines, None)
        if not line:
            continue
        with _parsing(path, number):
            _, *pose, camera_id, name = line.split(maxsplit=9)
            values = [float(value) for value in pose]
            if len(values) != 7:
                raise ValueError("an image line needs 10 fields")
        # An image without keypoints has an empty second line, which some tools leave out.
        keypoints = ""
        if following is not None and _NUMBERS.fullmatch(following[1]):
            (number, keypoints), following = following, next(lines, None)
        with _parsing(path, number):
            seen = np.array(keypoints.split(), np.float64).reshape(-1, 3)
            record = _image(name, int(camera_id), values, seen[:, :2], seen[:, 2])
        yield record


def _text_points(path: Path) -> np.ndarray:
    rows = []
    for number, line in _text_lines(path):
        with _parsing(path, number):
            fields = line.split(maxsplit=8)
            if len(fields) < 8:
                raise ValueError("a point line needs at least 8 fields")
            color = tuple(int(value) & 255 for value in fields[4:7])
            rows.append((np.int64(fields[0]), tuple(map(float, fields[1:4])), color))
    return np.array(rows, _POINT)


def _text_lines(path: Path, *, blank: bool = False) -> Iterator[tuple[int, str]]:
    """Yield (line number, stripped line) without comments."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for number, raw in enumerate(file, 1):
            line = raw.strip()
            if not line.startswith("#") and (line or blank):
                yield number, line


def _image(
    name: str, camera_id: int, pose: list[float], xy: np.ndarray, ids: np.ndarray
) -> ImageRecord:
    tracked, (qvec, tvec) = ids >= 0, np.split(np.array(pose), [4])
    xy, ids = np.asarray(xy[tracked], np.float64), ids[tracked].astype(np.int64)
    return ImageRecord(name.replace("\\", "/"), camera_id, qvec, tvec, xy, ids)


def _unsupported(path: Path, model: str) -> UserError:
    supported = ", ".join(sorted(name for name, (_, focals) in _MODELS.items() if focals))
    why = f"uses the camera model {model}; supported are {supported}"
    undistort = "run `colmap image_undistorter` and use the folder it writes"
    return broken(path, why, CUT if model == "EQUIRECTANGULAR" else undistort)
