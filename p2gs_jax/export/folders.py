"""The scene as folders of other programs: a COLMAP model, and nerfstudio's `transforms.json`.

Cameras are pinholes at the size of the fit, and the photographs are undistorted to match. Points
and tracks are those the fit started from. Neither program has a place for exposures:
`exposures.csv` lies beside them; it is what `--known-exposures` reads.
"""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap
from jaxtyping import Bool, Float
from PIL import Image

from p2gs_jax.core.atomic import atomic_folder, write_json, write_text
from p2gs_jax.core.ply import header_of
from p2gs_jax.errors import UserError
from p2gs_jax.run.photometry_files import ViewPhotometry
from p2gs_jax.scene import ImageStore
from p2gs_jax.types import Scene, View

JPEG_QUALITY = 98
# nerfstudio's file of points, and the colour of points without one.
CLOUD, GREY = "sparse_pc.ply", 128
RGB = ("red", "green", "blue")
Program = Literal["colmap", "nerfstudio"]


def write_folder(
    program: Program,
    folder: Path,
    scene: Scene,
    store: ImageStore,
    photometry: Sequence[ViewPhotometry],
    *,
    on_view: Callable[[int, int], None] = lambda done, count: None,
) -> None:
    """Write `images`, `exposures.csv`, `masks` where a view has any, and the scene for a program.

    COLMAP reads `sparse/0`; nerfstudio's `splatfacto` reads `transforms.json` and `sparse_pc.ply`.
    The folder is replaced once the new one is whole. The store has cameras at the size of the fit;
    `on_view` receives how many photographs are written, and of how many. A UserError says that a
    photograph cannot be read, or not be written under its name.
    """
    with atomic_folder(folder) as temporary:
        write_text(temporary / "exposures.csv", exposure_table(photometry))
        masks: dict[str, Bool[np.ndarray, "h w"]] = {}
        for index, view in enumerate(scene.views):
            ldr, mask = store.get(index)
            _write_photograph(temporary / "images" / view.name, view, ldr)
            masks[view.name] = mask > 0
            on_view(index + 1, len(scene.views))
        masked = {name for name, mask in masks.items() if not mask.all()}
        if program == "nerfstudio":
            _write_points(temporary / CLOUD, scene)
            write_json(temporary / "transforms.json", _transforms(scene, store, masked))
        else:
            _write_model(temporary / "sparse" / "0", scene, store)
            masked = set(masks) if masked else masked
        for name in masked:
            path = temporary / _place_of_mask(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            # 255 where the photograph is to be used.
            Image.fromarray(255 * masks[name].astype(np.uint8)).save(path)


def _place_of_mask(name: str) -> str:
    """Return COLMAP's name of a mask: the photograph's, suffix included, and .png."""
    return (Path("masks") / f"{name}.png").as_posix()


def _transforms(scene: Scene, store: ImageStore, masked: set[str]) -> dict[str, Any]:
    """Return the content of `transforms.json`; some views have masks, by name."""
    frames = []
    names: dict[str, list[str]] = {"train": [], "test": []}
    for index, view in enumerate(scene.views):
        place = (Path("images") / view.name).as_posix()
        names[view.split].append(place)
        frames.append(_frame(store, index) | {"file_path": place})
        if view.name in masked:
            frames[-1]["mask_path"] = _place_of_mask(view.name)
    content: dict[str, Any] = {"camera_model": "PINHOLE", "ply_file_path": CLOUD}
    if names["test"]:
        content["train_filenames"] = names["train"]
        content["val_filenames"] = content["test_filenames"] = names["test"]
    return {**content, "frames": frames}


def exposure_table(photometry: Sequence[ViewPhotometry]) -> str:
    """Return exposures as CSV; a held-out view's is that fitted to its photograph.

    Where white balance is modelled, its factors follow.
    """
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    balanced = any(v.get("white_balance") is not None for v in photometry)
    more = RGB if balanced else ()
    table.writerow(("image", "camera", "split", "ev", "exposure", "gamma", *more))
    for v in photometry:
        e = v["exposure_fitted"] if v["exposure"] is None else v["exposure"]
        ev = "" if e is None else repr(float(np.log2(e)))
        balance = (v.get("white_balance") or [None] * 3) if balanced else ()
        table.writerow((v["image"], v["camera"], v["split"], ev, e, v["gamma"], *balance))
    return out.getvalue()


def _colors(scene: Scene) -> np.ndarray:
    colors = scene.point_colors
    return np.full(scene.points.shape, GREY, np.uint8) if colors is None else colors


def _write_model(folder: Path, scene: Scene, store: ImageStore) -> None:
    model = pycolmap.Reconstruction()
    camera_ids: dict[tuple, int] = {}
    tracks = [pycolmap.Track() for _ in scene.points]
    for index, view in enumerate(scene.views):
        viewmat, K, width, height = store.camera(index)
        params = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
        size = {"width": width, "height": height}
        key = (view.camera, width, height, *params)
        camera_id = camera_ids.setdefault(key, len(camera_ids) + 1)
        if camera_id not in model.cameras:
            camera = pycolmap.Camera(model="PINHOLE", params=params, camera_id=camera_id, **size)
            model.add_camera_with_trivial_rig(camera)
        xy, points = np.zeros((0, 2)), np.zeros(0, int)
        if scene.tracks is not None:
            rows = np.flatnonzero(scene.tracks.view_indices == index)
            xy, points = scene.tracks.xy[rows], scene.tracks.point_indices[rows]
        image = pycolmap.Image(
            name=view.name,
            keypoints=np.asarray(xy * (width / view.width, height / view.height), np.float64),
            camera_id=camera_id,
            image_id=index + 1,
        )
        pose = np.asarray(viewmat, np.float64)
        # The rotation that the float32 matrix was rounded from, orthonormal in float64.
        u, _, vt = np.linalg.svd(pose[:3, :3])
        pose_of_image = pycolmap.Rigid3d(pycolmap.Rotation3d(u @ vt), pose[:3, 3])
        model.add_image_with_trivial_frame(image, pose_of_image)
        for slot, point in enumerate(points):
            tracks[point].add_element(index + 1, slot)
    for xyz, track, color in zip(scene.points, tracks, _colors(scene), strict=True):
        model.add_point3D(xyz.astype(np.float64), track, color)
    # Mean distance of a point's projections from its observations: what COLMAP itself writes.
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))


def _write_photograph(path: Path, view: View, ldr: Float[np.ndarray, "h w 3"]) -> None:
    """Copy a photograph that is used as it is; encode a changed one again, EXIF included.

    A UserError says that its own format cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = ldr.shape[:2]
    if view.distortion is None and (width, height) == (view.width, view.height):
        shutil.copyfile(view.image_path, path)
        return
    picture = Image.fromarray(np.rint(255 * ldr).astype(np.uint8))
    with Image.open(view.image_path) as original:
        info = original.info
        kept: dict[str, Any] = {k: info[k] for k in ("exif", "icc_profile") if info.get(k)}
    if path.suffix.lower() in (".jpg", ".jpeg"):
        kept |= {"quality": JPEG_QUALITY, "subsampling": 0}
    try:
        picture.save(path, **kept)
    except (OSError, ValueError, KeyError) as error:
        raise UserError(
            f"{view.name} cannot be written in its own format: {error}.",
            fix="convert the photographs to JPEG or PNG and fit again",
        ) from error


def _frame(store: ImageStore, index: int) -> dict[str, Any]:
    """Return a camera in nerfstudio's words: OpenGL's axes, pixels, corners at whole numbers."""
    viewmat, K, width, height = store.camera(index)
    pose = np.linalg.inv(np.asarray(viewmat, np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    numbers = {name: float(value) for name, value in lens.items()}
    return {**numbers, "w": width, "h": height, "transform_matrix": pose.tolist()}


def _write_points(path: Path, scene: Scene) -> None:
    fields = [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in RGB]
    table, colors = np.empty(len(scene.points), fields), _colors(scene)
    for column, (axis, channel) in enumerate(zip("xyz", RGB, strict=True)):
        table[axis], table[channel] = scene.points[:, column], colors[:, column]
    path.write_bytes(header_of("vertex", table.dtype, len(table)) + table.tobytes())
