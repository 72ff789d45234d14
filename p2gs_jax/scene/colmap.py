"""A COLMAP model and its photographs as a Scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.colmap_model import (
    CameraRecord,
    ImageRecord,
    Model,
    is_model,
    read_model,
    unsupported_camera,
)
from p2gs_jax.scene.files import HUGE, at_file_size, check_missing, image_folder, require_inside
from p2gs_jax.scene.lens import intrinsics, make_distortion, undistort_points
from p2gs_jax.types import Distortion, Scene, Tracks, View

_FIX = "export the model again from COLMAP"
# Number of focal lengths in the parameters of the supported camera models.
_FOCALS = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"), 1),
    **dict.fromkeys(("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), 1),
    **dict.fromkeys(("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"), 2),
}


def find_model(root: Path) -> Path | None:
    """Return the folder of the COLMAP model of a scene: `sparse/0`, `sparse` or the root itself."""
    candidates = (root / "sparse" / "0", root / "sparse", root)
    return next((folder for folder in candidates if is_model(folder)), None)


def load_colmap(root: Path, folder: Path, cfg: DataConfig) -> Scene:
    """Read a COLMAP model; views have no split, masks or EXIF yet.

    Args:
        root: the folder the user named.
        folder: where the model lies.
        cfg: where the images are, and whether some may be missing.

    Raises:
        UserError: a file is broken, images are missing or of another size, the camera model is
            not supported, or there is nothing in the model.
    """
    model = read_model(folder)
    _check_model(model)
    images = sorted(model.images, key=lambda image: image.name)
    place = image_folder(root, cfg) or _find_images(root, folder, images)
    for image in images:
        require_inside(PurePosixPath(image.name), place, model.file("images"))
    missing = [image.name for image in images if not (place / image.name).is_file()]
    notes = check_missing(missing, len(images), model.file("images"), cfg)
    skipped = set(missing)
    images = [image for image in images if image.name not in skipped]

    fallback = _camera_names(images)
    views, resized = [], []
    for image in images:
        camera, path = model.cameras[image.camera_id], place / image.name
        K, distortion = _lens(model.file("cameras"), camera)
        size = (camera.width, camera.height)
        K, width, height = at_file_size(path, K, size, model.file("cameras"))
        if (width, height) != size:
            resized.append(f"{width}x{height} instead of {camera.width}x{camera.height}")
        views.append(
            View(
                name=image.name,
                image_path=path,
                camera=subfolder(image.name) or fallback[image.camera_id],
                viewmat=_viewmat(image, model.file("images")),
                K=K,
                width=width,
                height=height,
                distortion=distortion,
            )
        )
    if resized:
        notes.append(
            f"{len(resized)} images have another size than their camera (the first: {resized[0]}): "
            "intrinsics were rescaled"
        )
    others = sorted(p.name for p in folder.parent.iterdir() if p != folder and is_model(p))
    if folder.name == "0" and others:
        notes.append(f"used the model {folder}; beside it lie {', '.join(others)}, not used")
    return Scene(
        root=root,
        format="colmap",
        views=tuple(views),
        points=model.xyz.astype(np.float32),
        point_colors=model.rgb,
        tracks=tracks_of(model, views),
        notes=tuple(notes),
    )


def tracks_of(model: Model, views: Sequence[View]) -> Tracks | None:
    """Return every observation of the model's points, in undistorted pixels of the views.

    Observations of points that the model does not have (some tools thin points3D without touching
    the images file) and of images that are not among the views are left out.

    Args:
        model: what COLMAP wrote; keypoints are at the resolution of its cameras.
        views: matched by name; keypoints are rescaled to their size.
    """
    if len(model.point_ids) == 0:
        return None
    rows = {view.name: i for i, view in enumerate(views)}
    view_rows, point_rows, positions = [], [], []
    for image in sorted(model.images, key=lambda image: image.name):
        row = rows.get(image.name)
        if row is None or len(image.point_ids) == 0:
            continue
        view, camera = views[row], model.cameras[image.camera_id]
        at = np.searchsorted(model.point_ids, image.point_ids).clip(max=len(model.point_ids) - 1)
        known = (model.point_ids[at] == image.point_ids) & (np.abs(image.xy) < HUGE).all(axis=1)
        scale = (view.width / camera.width, view.height / camera.height)
        xy = undistort_points(image.xy[known] * scale, view.K, view.distortion)
        # What a wide lens sees at its sides is in no pinhole picture.
        seen = np.isfinite(xy).all(axis=1)
        positions.append(xy[seen])
        point_rows.append(at[known][seen])
        view_rows.append(np.full(int(seen.sum()), row))
    if not positions:
        return None
    return Tracks(
        view_indices=np.concatenate(view_rows).astype(np.int32),
        point_indices=np.concatenate(point_rows).astype(np.int32),
        xy=np.concatenate(positions),
    )


def subfolder(name: str) -> str | None:
    """Return the top folder of an image's relative name, or None."""
    parts = PurePosixPath(name).parts
    return parts[0] if len(parts) > 1 else None


def _camera_names(images: Sequence[ImageRecord]) -> dict[int, str]:
    """Name cameras by id; a model with one camera per image does not identify the same ones."""
    uses = Counter(image.camera_id for image in images)
    alone = len(uses) > 1 and max(uses.values()) == 1
    return {camera_id: "0" if alone else str(camera_id) for camera_id in uses}


def _check_model(model: Model) -> None:
    if not model.cameras:
        raise broken(model.file("cameras"), "holds no cameras", _FIX)
    if not model.images:
        fix = "COLMAP's mapping found nothing; run it again on these photographs"
        raise broken(model.file("images"), "holds no registered images", fix)
    twice = [name for name, n in Counter(i.name for i in model.images).items() if n > 1]
    if twice:
        raise broken(model.file("images"), f"lists {twice[0]} more than once", _FIX)
    for image in model.images:
        if image.camera_id not in model.cameras:
            why = f"{image.name} was taken by camera {image.camera_id}, which "
            why += f"{model.file('cameras')} does not have"
            raise broken(f"{model.file('images')}:", why, _FIX)
    bad = int((~(np.abs(model.xyz) < HUGE).all(axis=1)).sum())
    if bad:
        why = f"{bad} of {len(model.xyz)} points are not finite"
        raise broken(f"{model.file('points3D')}:", why, _FIX)


def _find_images(root: Path, folder: Path, images: Sequence[ImageRecord]) -> Path:
    places = [base / "images" for base in dict.fromkeys((root, *list(folder.parents)[:2]))]
    for place in places:
        if place.is_dir():
            return place
    if any((root / image.name).is_file() for image in images):
        return root
    looked = ", ".join(map(str, places))
    raise UserError(
        f"no image folder for the COLMAP model {folder}: looked for {looked}",
        fix="name the folder with --images",
    )


def _viewmat(image: ImageRecord, path: Path) -> Float[np.ndarray, "4 4"]:
    finite = (np.abs([*image.qvec, *image.tvec]) < HUGE).all()
    norm = np.linalg.norm(image.qvec) if finite else 0.0
    if norm < 1e-6:
        raise broken(f"{path}:", f"the pose of {image.name} is not finite", _FIX)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_quat(np.roll(image.qvec / norm, -1)).as_matrix()
    viewmat[:3, 3] = image.tvec
    return viewmat.astype(np.float32)


def _lens(path: Path, camera: CameraRecord) -> tuple[Float[np.ndarray, "3 3"], Distortion | None]:
    """Return K and distortion: COLMAP's terms are OpenCV's, and absent ones are 0."""
    if camera.model not in _FOCALS:
        raise unsupported_camera(path, camera.model)
    focals, p = _FOCALS[camera.model], camera.params
    fx, fy, (cx, cy) = p[0], p[focals - 1], p[focals : focals + 2]
    if not ((np.abs(p) < HUGE).all() and fx > 0 and fy > 0 and camera.width and camera.height):
        why = f"a {camera.model} camera of {camera.width}x{camera.height} pixels has "
        raise broken(f"{path}:", f"{why}impossible parameters {p}", _FIX)
    terms = p[focals + 2 :]
    model = "fisheye" if "FISHEYE" in camera.model else "radial"
    return intrinsics(fx, fy, cx, cy), make_distortion((*terms, *[0.0] * (4 - len(terms))), model)
