"""A folder as nerfstudio's `splatfacto` reads it: transforms.json, images, masks, sparse_pc.ply.

Cameras are pinholes at the size of the fit, and the photographs are undistorted to match.
`exposures.csv` lies beside them: nerfstudio has no place for exposures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.core.atomic import atomic_folder, write_json, write_text
from p2gs_jax.core.ply import header_of
from p2gs_jax.export.colmap_folder import exposure_table, write_mask, write_photograph
from p2gs_jax.run.photometry_files import ViewPhotometry
from p2gs_jax.scene import ImageStore
from p2gs_jax.types import Scene

CLOUD = "sparse_pc.ply"
GREY = 128


def write_nerfstudio_folder(
    folder: Path,
    scene: Scene,
    store: ImageStore,
    photometry: Sequence[ViewPhotometry],
    *,
    on_view: Callable[[int, int], None] = lambda done, count: None,
) -> None:
    """Write the folder.

    Args:
        folder: replaced once the new one is whole.
        scene: views and points.
        store: photographs and cameras at the size of the fit.
        photometry: exposures of the views.
        on_view: photographs written, views in all.

    Raises:
        UserError: a photograph cannot be read, or not be written under its name.
    """
    with atomic_folder(folder) as temporary:
        write_text(temporary / "exposures.csv", exposure_table(photometry))
        _write_points(temporary / CLOUD, scene)
        frames = []
        for index, view in enumerate(scene.views):
            ldr, mask = store.get(index)
            place = Path("images") / view.name
            write_photograph(temporary / place, view, ldr)
            frames.append(_frame(store, index) | {"file_path": place.as_posix()})
            if not (mask > 0).all():
                there = Path("masks") / f"{view.name}.png"
                write_mask(temporary / there, mask > 0)
                frames[-1]["mask_path"] = there.as_posix()
            on_view(index + 1, len(scene.views))
        names: dict[str, list[str]] = {"train": [], "test": []}
        for view, frame in zip(scene.views, frames, strict=True):
            names[view.split].append(frame["file_path"])
        splits = {
            "train_filenames": names["train"],
            "val_filenames": names["test"],
            "test_filenames": names["test"],
        }
        write_json(
            temporary / "transforms.json",
            {
                "camera_model": "PINHOLE",
                "ply_file_path": CLOUD,
                **(splits if names["test"] else {}),
                "frames": frames,
            },
        )


def _frame(store: ImageStore, index: int) -> dict[str, Any]:
    """Return a camera in nerfstudio's words: OpenGL's axes, pixels, corners at whole numbers."""
    viewmat, K, width, height = store.camera(index)
    pose = np.linalg.inv(np.asarray(viewmat, np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return {
        "fl_x": float(K[0, 0]),
        "fl_y": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "w": width,
        "h": height,
        "transform_matrix": pose.tolist(),
    }


def _write_points(path: Path, scene: Scene) -> None:
    colors = scene.point_colors
    if colors is None:
        colors = np.full(scene.points.shape, GREY, np.uint8)
    fields = [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    table = np.empty(len(scene.points), fields)
    for column, name in enumerate("xyz"):
        table[name] = scene.points[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        table[name] = colors[:, column]
    path.write_bytes(header_of("vertex", table.dtype, len(table)) + table.tobytes())
