"""References of evaluation: photographs under one common exposure, and true radiance."""

from __future__ import annotations

import dataclasses
import glob
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.radiance import Truth
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.scene.convert.readers import CONVERTED_SUFFIXES
from p2gs_jax.scene.files import IMAGE_SUFFIXES, image_size
from p2gs_jax.scene.hdr_sets import true_radiance
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import Scene

Reference = Callable[[int], np.ndarray | None]


def check_reference(folder: str | Path | None) -> None:
    """Raise UserError if a folder of references does not exist; None: there is no folder."""
    if folder is not None and not Path(folder).is_dir():
        fix = "give --reference a folder of photographs"
        raise UserError(f"{folder} is not a folder.", fix=fix)


def load_reference(folder: str | Path, scene: Scene, cfg: FitConfig) -> Reference:
    """Return a function from a view's row to its photograph under the common exposure, or None.

    Raises UserError: the folder does not exist or holds no photograph of any view, or a file there
    has another size than the view or is of a kind that is read only in scenes.
    """
    folder = Path(folder)
    check_reference(folder)
    rows = {}
    for row, view in enumerate(scene.views):
        alike = glob.escape(Path(view.name).with_suffix("").as_posix()) + ".*"
        named = [folder / view.name, *sorted(folder.glob(alike))]
        named = [p for p in named if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()]
        found = min(named, key=lambda p: p.suffix.lower() in CONVERTED_SUFFIXES, default=None)
        if found is None:
            continue
        if found.suffix.lower() in CONVERTED_SUFFIXES:
            why = f"--reference: {found} is neither PNG nor JPEG nor TIFF."
            raise UserError(why, fix="give --reference copies as PNG, with 8 or 16 bits")
        (width, height), size = image_size(found), (view.width, view.height)
        if (width, height) != size:
            why = f"--reference: {found} has {width}x{height} pixels, but the photograph of the "
            why += f"scene {size[0]}x{size[1]}."
            raise UserError(why, fix="give --reference photographs at the size of the scene's")
        rows[row] = dataclasses.replace(view, image_path=found, mask_path=None)
    if not rows:
        why = f"{folder} holds no photograph with the name of a view (for example "
        why += f"{scene.views[0].name})."
        raise UserError(why, fix="name the reference photographs as the scene's images")
    # References are not cached: evaluation reads each only a few times.
    store = ImageStore(tuple(rows.values()), dataclasses.replace(cfg.data, cache_mb=0))
    where = {row: place for place, row in enumerate(rows)}
    return lambda row: store.get(where[row], 1)[0] if row in where else None


def find_radiance(scene: Scene, store: ImageStore) -> Truth | None:
    """Return a function from a view's row to its true linear radiance, or None without any truth.

    The truth is in `truth/linear`, or the scene is an HDR set. Only evaluation uses it.
    """
    names = (scene.root / "truth" / "linear" / view.name for view in scene.views)
    exrs = [path.with_suffix(".exr") for path in names]
    both = zip(scene.views, exrs, strict=True)
    paths = [path if path.is_file() else true_radiance(scene.root, view) for view, path in both]
    if not any(paths):
        return None

    def radiance(row: int) -> np.ndarray | None:
        path = paths[row]
        if path is None:
            return None
        linear, *_ = read_exr(path)
        camera = camera_of(store, row)
        if linear.shape[:2] == (camera.height, camera.width):
            return linear
        return cv2.resize(linear, (camera.width, camera.height), interpolation=cv2.INTER_AREA)

    return radiance
