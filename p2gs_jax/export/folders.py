"""The scene as folders of other programs: a COLMAP model, and nerfstudio's `transforms.json`.

Cameras are pinholes at the image size of the fit, and the photographs are undistorted to match.
Points and tracks are those at the start of the fit. Neither format stores exposures: they are in
`exposures.csv`, which `--known-exposures` reads.
"""

from __future__ import annotations

import contextlib
import csv
import io
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from PIL import ExifTags, Image

from p2gs_jax.core.atomic import atomic_folder, atomic_write, write_json, write_text
from p2gs_jax.core.colmap import pycolmap
from p2gs_jax.core.ply import header_of
from p2gs_jax.photometry.observations import grouped
from p2gs_jax.run.photometry_files import ViewPhotometry
from p2gs_jax.scene import ImageStore
from p2gs_jax.scene.convert.convert import kept_settings, write_png
from p2gs_jax.scene.convert.icc import profile_of
from p2gs_jax.scene.pixels.decode import floats
from p2gs_jax.types import Scene, Tracks, View

JPEG_QUALITY = 98
# Suffixes that both programs read (others become PNG), and Pillow modes that need no new encoding.
READABLE, MODES = (".jpg", ".jpeg", ".png"), ("L", "RGB", "RGBA")
# nerfstudio's file of points, and the 8-bit grey of points without a colour.
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
    """Write `images`, `exposures.csv`, `masks` if there are any, and the scene for a program.

    COLMAP reads `sparse/0`; nerfstudio's `splatfacto` reads `transforms.json` and `sparse_pc.ply`.
    Coordinates are as in the data set, without the shift by `Scene.origin`. The folder is
    replaced once the new one is complete. `on_view` receives the number of written photographs
    and the number of all. Raises UserError: a photograph cannot be read.
    """
    names = {view.name: exported_name(view) for view in scene.views}
    with atomic_folder(folder) as temporary:
        write_text(temporary / "exposures.csv", exposure_table(photometry, names))
        masked = False
        for index, view in enumerate(scene.views):
            ldr, mask = store.get(index)
            place = temporary / "images" / names[view.name]
            _write_photograph(place, view, _with_alpha(ldr, store, index))
            path = temporary / mask_name(names[view.name])
            path.parent.mkdir(parents=True, exist_ok=True)
            # 255 marks pixels that count.
            Image.fromarray(np.where(mask > 0, 255, 0).astype(np.uint8)).save(path)
            masked |= not (mask > 0).all()
            on_view(index + 1, len(scene.views))
        # nerfstudio needs masks for all photographs or for none.
        if not masked:
            shutil.rmtree(temporary / "masks")
        if program == "nerfstudio":
            _write_points(temporary / CLOUD, scene)
            write_json(temporary / "transforms.json", _transforms(scene, store, names, masked))
        else:
            _write_model(temporary / "sparse" / "0", scene, store, names)


def exported_name(view: View) -> str:
    """Return the name of an exported photograph: the view's name, with .png added if needed."""
    return view.name if Path(view.name).suffix.lower() in READABLE else f"{view.name}.png"


def mask_name(name: str) -> str:
    """Return the path of a mask as COLMAP expects it: .png follows the photograph's suffix."""
    return f"masks/{name}.png"


def _transforms(
    scene: Scene, store: ImageStore, exported: Mapping[str, str], masked: bool
) -> dict[str, Any]:
    """Return the content of `transforms.json`."""
    frames = []
    names: dict[str, list[str]] = {"train": [], "test": []}
    for index, view in enumerate(scene.views):
        place = (Path("images") / exported[view.name]).as_posix()
        names[view.split].append(place)
        frames.append(_frame(store, index, scene.origin) | {"file_path": place})
        if masked:
            frames[-1]["mask_path"] = mask_name(exported[view.name])
    content: dict[str, Any] = {"camera_model": "PINHOLE", "ply_file_path": CLOUD}
    if names["test"]:
        content["train_filenames"] = names["train"]
        content["val_filenames"] = content["test_filenames"] = names["test"]
    return {**content, "frames": frames}


def exposure_table(photometry: Sequence[ViewPhotometry], names: Mapping[str, str]) -> str:
    """Return exposures by exported name as CSV; a held-out view has its fitted exposure.

    If white balance is modelled, its factors are the last columns.
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
        table.writerow((names[v["image"]], v["camera"], v["split"], ev, e, v["gamma"], *balance))
    return out.getvalue()


def _colors(scene: Scene) -> np.ndarray:
    colors = scene.point_colors
    return np.full(scene.points.shape, GREY, np.uint8) if colors is None else colors


def _write_model(folder: Path, scene: Scene, store: ImageStore, names: Mapping[str, str]) -> None:
    model = pycolmap.Reconstruction()
    none = np.zeros(0, np.int32)
    observed = scene.tracks or Tracks(none, none, np.zeros((0, 2), np.float32))
    of_view = grouped(observed.view_indices, len(scene.views))
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
        rows = of_view[index]
        xy, points = observed.xy[rows], observed.point_indices[rows]
        image = pycolmap.Image(
            name=names[view.name],
            keypoints=np.asarray(xy * (width / view.width, height / view.height), np.float64),
            camera_id=camera_id,
            image_id=index + 1,
        )
        pose = np.asarray(viewmat, np.float64)
        # The nearest rotation to the float32 matrix is orthonormal in float64.
        u, _, vt = np.linalg.svd(pose[:3, :3])
        rotation = pycolmap.Rotation3d(u @ vt)
        pose_of_image = pycolmap.Rigid3d(rotation, pose[:3, 3] - u @ vt @ scene.origin)
        model.add_image_with_trivial_frame(image, pose_of_image)
        for slot, point in enumerate(points):
            tracks[point].add_element(index + 1, slot)
    for xyz, track, color in zip(scene.points, tracks, _colors(scene), strict=True):
        model.add_point3D(xyz.astype(np.float64) + scene.origin, track, color)
    # COLMAP's point error is the mean distance of projections from observations.
    model.update_point_3d_errors()
    folder.mkdir(parents=True)
    model.write_binary(str(folder))
    if held_out := [names[view.name] for view in scene.views if view.split == "test"]:
        write_text(folder / "test.txt", "\n".join(held_out) + "\n")


def _with_alpha(
    ldr: Float[np.ndarray, "h w 3"], store: ImageStore, index: int
) -> Float[np.ndarray, "h w c"]:
    """Return display values; if the photograph has alpha, with it and without the backdrop."""
    opacity = store.alpha(index)
    if opacity is None or opacity.min() == np.iinfo(opacity.dtype).max:
        return ldr
    alpha = floats(opacity)[..., None]
    own = (ldr - (1 - alpha) * store.backdrop) / np.maximum(alpha, 1e-6)
    return np.concatenate([np.clip(own, 0, 1), alpha], 2)


def is_copied(view: View, path: Path) -> bool:
    """Return whether programs read the same from a copy of the photograph at `path` as we do.

    The suffix of `path`, the orientation in EXIF, the mode or a colour profile may rule this out.
    """
    with contextlib.suppress(OSError), Image.open(view.image_path) as image:
        plain = image.mode in MODES and profile_of(image) is None  # before pixels are read
        upright = image.getexif().get(ExifTags.Base.Orientation, 1) in (0, 1)
        same = view.image_path.suffix.lower() == path.suffix.lower()
        return same and upright and plain
    return False


def _write_photograph(path: Path, view: View, shown: Float[np.ndarray, "h w c"]) -> None:
    """Copy the file if the fit neither undistorts nor resizes it; otherwise encode it in sRGB.

    A new file keeps the camera settings in EXIF, but neither orientation nor colour space.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unchanged = view.distortion is None and shown.shape[1::-1] == (view.width, view.height)
    if unchanged and is_copied(view, path):
        shutil.copyfile(view.image_path, path)
        return
    exif = None
    with contextlib.suppress(OSError), Image.open(view.image_path) as original:
        exif = original.getexif()
        exif.get_ifd(ExifTags.IFD.Exif)  # read while the file is open
    write_photograph(path, np.rint(255 * shown).astype(np.uint8), exif)


def write_photograph(path: Path, pixels: np.ndarray, exif: Image.Exif | None) -> None:
    """Write sRGB values as PNG (8 or 16 bits) or else JPEG, with the camera settings in EXIF."""
    if path.suffix.lower() == ".png":
        write_png(path, pixels, exif)
        return
    settings = kept_settings(exif)
    options: dict[str, Any] = {"exif": b"Exif\0\0" + settings} if settings else {}
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, quality=JPEG_QUALITY, subsampling=0, **options)


def _frame(store: ImageStore, index: int, origin: Sequence[float]) -> dict[str, Any]:
    """Return a camera in nerfstudio's format: OpenGL's axes, pixel corners at integers."""
    viewmat, K, width, height = store.camera(index)
    pose = np.linalg.inv(np.asarray(viewmat, np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] += origin
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    numbers = {name: float(value) for name, value in lens.items()}
    return {**numbers, "w": width, "h": height, "transform_matrix": pose.tolist()}


def _write_points(path: Path, scene: Scene) -> None:
    number = "<f8" if any(scene.origin) else "<f4"
    fields = [(n, number) for n in "xyz"] + [(n, "u1") for n in RGB]
    points = scene.points + np.array(scene.origin)
    table, colors = np.empty(len(scene.points), fields), _colors(scene)
    for column, (axis, channel) in enumerate(zip("xyz", RGB, strict=True)):
        table[axis], table[channel] = points[:, column], colors[:, column]
    path.write_bytes(header_of(table.dtype, len(table)) + table.tobytes())
