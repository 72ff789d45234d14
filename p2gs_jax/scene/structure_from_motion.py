"""Cameras, points and tracks from nothing but a folder of photographs."""

from __future__ import annotations

import dataclasses
import shutil
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pycolmap

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.cache import cached_folder, file_fingerprints
from p2gs_jax.scene.colmap import load_colmap, subfolder
from p2gs_jax.scene.exif import read_exif_camera
from p2gs_jax.scene.features import extract, match, pairs_by_name, quiet_colmap
from p2gs_jax.scene.files import image_size
from p2gs_jax.types import Scene

_ADVICE = (
    "photographs register when they are sharp, textured and overlap by more than half with at "
    "least two others, taken from different places"
)


def load_images(
    root: Path,
    image_folder: Path,
    paths: Sequence[Path],
    cfg: DataConfig,
    work_dir: Path | None,
    report: Callable[[str], None],
) -> Scene:
    """Run COLMAP's incremental structure from motion on the CPU and read the largest model.

    Args:
        root: the folder the user named.
        image_folder: holds the photographs.
        paths: the photographs, in it or in its subfolders.
        cfg: passed on to the COLMAP reader.
        work_dir: keeps the result under `sfm/`; it is reused while names, sizes and modification
            times of the photographs stay the same.
        report: receives progress.

    Raises:
        UserError: fewer than two photographs, one of them is no image, or none registered.
    """
    names = [path.relative_to(image_folder).as_posix() for path in paths]
    if len(paths) < 2:
        raise UserError(
            f"{image_folder} holds {len(paths)} image(s); a reconstruction needs at least two",
            fix="add photographs of the same place from different positions",
        )
    groups: dict[tuple, list[str]] = defaultdict(list)
    for path, name in zip(paths, names, strict=True):
        groups[(image_size(path), read_exif_camera(path), subfolder(name))].append(name)
    key = {"pycolmap": pycolmap.__version__, "files": file_fingerprints(paths)}

    def build(folder: Path) -> None:
        _build(folder, image_folder, groups, report)

    with cached_folder(work_dir, "sfm", key, build) as folder:
        scene = load_colmap(
            root, folder / "model", dataclasses.replace(cfg, images=str(image_folder.resolve()))
        )
    registered = {view.name for view in scene.views}
    left_out = [name for name in names if name not in registered]
    notes = list(scene.notes)
    if left_out:
        notes.append(
            f"{len(left_out)} of {len(names)} images could not be registered and are not used: "
            f"{', '.join(left_out)}; {_ADVICE}"
        )
    report(f"registered {len(registered)} of {len(names)} images, {len(scene.points)} points")
    return dataclasses.replace(scene, format="images", notes=tuple(notes))


def _build(
    folder: Path,
    image_folder: Path,
    groups: Mapping[tuple, Sequence[str]],
    report: Callable[[str], None],
) -> None:
    quiet_colmap()
    names = [name for group in groups.values() for name in group]
    database = folder / "database.db"
    done = 0
    for group in groups.values():
        report(f"detecting features: {done} of {len(names)} images")
        extract(database, image_folder, group, mode=pycolmap.CameraMode.SINGLE)
        done += len(group)
    pairs = pairs_by_name(names)
    n = len(names) * (len(names) - 1) // 2 if pairs is None else len(pairs)
    report(f"matching {n} image pairs")
    match(database, pairs)

    registered = 2

    def on_next_image() -> None:
        nonlocal registered
        registered += 1
        if registered % 5 == 0:
            report(f"mapping: {registered} of {len(names)} images")

    report("mapping: looking for the first pair")
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    output = folder / "models"
    output.mkdir()
    models = pycolmap.incremental_mapping(
        database, image_folder, output, options=options, next_image_callback=on_next_image
    )
    if not models:
        raise UserError(
            f"none of the {len(names)} images in {image_folder} could be registered", fix=_ADVICE
        )
    largest = max(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()))
    (folder / "model").mkdir()
    largest.write(folder / "model")
    database.unlink()  # large, and not needed again
    shutil.rmtree(output)
