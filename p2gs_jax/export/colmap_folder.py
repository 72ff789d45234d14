"""A COLMAP model of the scene for other programs, with the exposures beside it.

Cameras are PINHOLE at the size of the fit, and the photographs are undistorted to match. Points
and tracks are those the fit started from. COLMAP has no place for exposures: `exposures.csv` is
what `--known-exposures` reads.
"""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Bool, Float
from PIL import Image

from p2gs_jax.core.atomic import atomic_folder, write_text
from p2gs_jax.errors import UserError
from p2gs_jax.run.photometry_files import ViewPhotometry
from p2gs_jax.scene import ImageStore
from p2gs_jax.types import Scene, View

JPEG_QUALITY = 98


def write_colmap_folder(
    folder: Path,
    scene: Scene,
    store: ImageStore,
    photometry: Sequence[ViewPhotometry],
    *,
    on_view: Callable[[int, int], None] = lambda done, count: None,
) -> None:
    """Write `sparse/0`, `images`, `exposures.csv`, and `masks` where a view has any.

    Args:
        folder: replaced once the new one is whole.
        scene: views, points and tracks.
        store: photographs and cameras at the size of the fit.
        photometry: exposures of the views.
        on_view: photographs written, views in all.

    Raises:
        UserError: a photograph cannot be read, or not be written under its name.
    """
    with atomic_folder(folder) as temporary:
        _write_model(temporary / "sparse" / "0", scene, store)
        write_text(temporary / "exposures.csv", exposure_table(photometry))
        masks: dict[str, Bool[np.ndarray, "h w"]] = {}
        for index, view in enumerate(scene.views):
            ldr, mask = store.get(index)
            write_photograph(temporary / "images" / view.name, view, ldr)
            masks[view.name] = mask > 0
            on_view(index + 1, len(scene.views))
        if not all(mask.all() for mask in masks.values()):
            for name, mask in masks.items():
                # COLMAP's name of a mask: the photograph's, suffix included, and .png.
                write_mask(temporary / "masks" / f"{name}.png", mask)


def exposure_table(photometry: Sequence[ViewPhotometry]) -> str:
    """Return exposures as CSV; a held-out view's is that fitted to its photograph.

    Where white balance is modelled, its factors follow.
    """
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    balanced = any(v.get("white_balance") is not None for v in photometry)
    more = ("red", "green", "blue") if balanced else ()
    table.writerow(("image", "camera", "split", "ev", "exposure", "gamma", *more))
    for v in photometry:
        e = v["exposure_fitted"] if v["exposure"] is None else v["exposure"]
        ev = "" if e is None else repr(float(np.log2(e)))
        balance = (v.get("white_balance") or [None] * 3) if balanced else ()
        table.writerow((v["image"], v["camera"], v["split"], ev, e, v["gamma"], *balance))
    return out.getvalue()


def _write_model(folder: Path, scene: Scene, store: ImageStore) -> None:
    model = pycolmap.Reconstruction()
    camera_ids: dict[tuple, int] = {}
    observed = _observations(scene)
    for index, view in enumerate(scene.views):
        viewmat, K, width, height = store.camera(index)
        params = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
        key = (view.camera, width, height, *params)
        if key not in camera_ids:
            camera_ids[key] = len(camera_ids) + 1
            camera = pycolmap.Camera(
                model="PINHOLE",
                width=width,
                height=height,
                params=params,
                camera_id=camera_ids[key],
            )
            model.add_camera_with_trivial_rig(camera)
        xy, _ = observed[index]
        image = pycolmap.Image(
            name=view.name,
            keypoints=np.asarray(xy * (width / view.width, height / view.height), np.float64),
            camera_id=camera_ids[key],
            image_id=index + 1,
        )
        pose = np.asarray(viewmat, np.float64)
        rotation = pycolmap.Rotation3d(_nearest_rotation(pose[:3, :3]))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, pose[:3, 3]))
    tracks = [pycolmap.Track() for _ in scene.points]
    for index, (_, points) in enumerate(observed):
        for slot, point in enumerate(points):
            tracks[point].add_element(index + 1, slot)
    colors = scene.point_colors
    if colors is None:
        colors = np.full(scene.points.shape, 128, np.uint8)
    for xyz, track, color in zip(scene.points, tracks, colors, strict=True):
        model.add_point3D(xyz.astype(np.float64), track, color)
    # Mean distance of a point's projections from its observations: what COLMAP itself writes.
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def _observations(scene: Scene) -> list[tuple[Float[np.ndarray, "n 2"], np.ndarray]]:
    """Return keypoints and the rows of their points by view; undistorted, at full size."""
    if scene.tracks is None:
        return [(np.zeros((0, 2)), np.zeros(0, int)) for _ in scene.views]
    t = scene.tracks
    rows = [np.flatnonzero(t.view_indices == index) for index in range(len(scene.views))]
    return [(t.xy[r], t.point_indices[r]) for r in rows]


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation that a float32 matrix was rounded from, orthonormal in float64."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt


def write_mask(path: Path, mask: Bool[np.ndarray, "h w"]) -> None:
    """Write a mask, 255 where it is to be used; its folder is created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(255 * mask.astype(np.uint8)).save(path)


def write_photograph(path: Path, view: View, ldr: np.ndarray) -> None:
    """Copy a photograph that is used as it is; encode a changed one again, EXIF included.

    Args:
        path: where to; its folder is created.
        view: of the photograph.
        ldr: its display values as the fit uses them.

    Raises:
        UserError: it cannot be written in its own format.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = ldr.shape[:2]
    if view.distortion is None and (width, height) == (view.width, view.height):
        shutil.copyfile(view.image_path, path)
        return
    picture = Image.fromarray(np.rint(255 * ldr).astype(np.uint8))
    with Image.open(view.image_path) as original:
        kept: dict[str, Any] = {
            k: original.info[k] for k in ("exif", "icc_profile") if original.info.get(k)
        }
    if path.suffix.lower() in (".jpg", ".jpeg"):
        kept |= {"quality": JPEG_QUALITY, "subsampling": 0}
    try:
        picture.save(path, **kept)
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{view.name} cannot be written in its own format: {error}.",
            fix="convert the photographs to JPEG or PNG and fit again",
        ) from error
