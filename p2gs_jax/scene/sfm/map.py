"""Cameras, points and tracks from nothing but photographs, and why some did not register."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pycolmap

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.cache import Report, cached_folder, file_fingerprints, stage_progress
from p2gs_jax.scene.colmap import load_colmap, subfolder
from p2gs_jax.scene.convert.headers import read_exif_camera
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.sfm.features import (
    kept_features,
    match_kept,
    opened,
    pairs_by_name,
    quiet_colmap,
)
from p2gs_jax.types import Scene

KEPT, ACCOUNT = "features", "account.json"
# Fewer features than this seldom give a pose.
FEW_FEATURES = 100
# COLMAP takes a pair with fewer inliers for unverified.
LEAST_INLIERS = 15
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
    report: Report,
) -> Scene:
    """Run COLMAP's structure from motion on the photographs in a folder; read the largest model.

    `work_dir` keeps it under `sfm/` while the photographs stay the same, and features and matches
    under `features/`, which serve more photographs or another mapper. Raises UserError: fewer than
    two photographs, one of them is not an image, none registered, or pycolmap lacks the mapper.
    """
    names = [path.relative_to(image_folder).as_posix() for path in paths]
    if len(paths) < 2:
        why = f"holds {len(paths)} image(s); a reconstruction needs at least two"
        fix = "add photographs of the same place from different positions"
        raise broken(image_folder, why, fix)
    groups: dict[tuple, list[str]] = defaultdict(list)
    for path, name in zip(paths, names, strict=True):
        groups[(image_size(path), read_exif_camera(path), subfolder(name))].append(name)
    key: dict[str, Any] = {"pycolmap": pycolmap.__version__, "files": file_fingerprints(paths)}
    if cfg.mapper != "incremental":
        key["mapper"] = cfg.mapper
    if cfg.mapper == "global" and not hasattr(pycolmap, "global_mapping"):
        fix = "pip install --upgrade pycolmap, or leave out --data.mapper global"
        raise broken(f"pycolmap {pycolmap.__version__}", "has no global mapper.", fix)

    def build(folder: Path) -> None:
        kept = (folder if work_dir is None else work_dir) / KEPT
        _build(folder, kept, image_folder, groups, cfg, report)

    with cached_folder(work_dir, "sfm", key, build) as folder:
        images = str(image_folder.resolve())
        scene = load_colmap(root, folder / "model", dataclasses.replace(cfg, images=images))
        why = json.loads((folder / ACCOUNT).read_text())["left_out"]
    registered = {view.name for view in scene.views}
    left_out = [name for name in names if name not in registered]
    notes = scene.notes
    if left_out:
        known = {name: why.get(name, "no reason is known") for name in left_out}
        note = f"{len(left_out)} of {len(names)} images could not be registered and are not used: "
        notes = (*notes, f"{note}{sentence(known)}; {_ADVICE}")
    report(f"registered {len(registered)} of {len(names)} images, {len(scene.points)} points")
    return dataclasses.replace(scene, format="images", notes=notes)


def _build(
    folder: Path,
    kept: Path,
    image_folder: Path,
    groups: Mapping[tuple, Sequence[str]],
    cfg: DataConfig,
    report: Report,
) -> None:
    """Fill the folder with the largest model and an account; the features are kept beside it."""
    quiet_colmap()
    names = [name for group in groups.values() for name in group]
    watch = Stopwatch()
    with watch("features"):
        database = kept_features(kept, image_folder, groups, report)
    with watch("matching"):
        pairs = match_kept(database, names, pairs_by_name(names, cfg.matching), report)
    models_folder = folder / "models"
    models_folder.mkdir()
    with watch("mapping"):
        run = _map_globally if cfg.mapper == "global" else _map
        found = run(database, image_folder, models_folder, len(names), report)
        models = sorted(found, key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)
    why = reasons(database, names, models)
    if not models:
        none = f"none of the {len(names)} images in {image_folder} could be registered"
        raise UserError(f"{none}: {sentence(why)}", fix=_ADVICE)
    (folder / "model").mkdir()
    models[0].write(folder / "model")
    spent = ", ".join(f"{stage} {seconds:.0f}" for stage, seconds in watch.seconds.items())
    report(f"structure from motion of {len(names)} images and {pairs} pairs, seconds: {spent}")
    account = {"images": len(names), "pairs": pairs, "seconds": watch.seconds, "left_out": why}
    write_json(folder / ACCOUNT, account)
    shutil.rmtree(models_folder)


def _map(
    database: Path, image_folder: Path, output: Path, count: int, report: Report
) -> list[pycolmap.Reconstruction]:
    registered, progress = 2, stage_progress(report, "mapping", count, "images")

    def on_next_image() -> None:
        nonlocal registered
        registered += 1
        progress(registered)

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    models = pycolmap.incremental_mapping(
        database, image_folder, output, options=options, next_image_callback=on_next_image
    )
    return list(models.values())


def _map_globally(
    database: Path, image_folder: Path, output: Path, count: int, report: Report
) -> list[pycolmap.Reconstruction]:
    """Map all photographs at once; focal lengths, which this does not find, come first."""
    report(f"mapping {count} images at once")
    # The copy keeps what it changes out of the matches that are kept.
    copy = output / database.name
    shutil.copyfile(database, copy)
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = 0
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    try:
        pycolmap.calibrate_view_graph(copy, calibration)
        models = pycolmap.global_mapping(copy, image_folder, output, options=options)
    except (RuntimeError, ValueError) as error:
        fix = "leave out --data.mapper global"
        raise UserError(f"the global mapper failed: {error}.", fix=fix) from error
    return list(models.values())


def reasons(
    database: Path, names: Sequence[str], models: Sequence[pycolmap.Reconstruction]
) -> dict[str, str]:
    """Return why photographs are not in the first model, in words, from the database of matches."""
    parts = [{model.image(i).name for i in model.reg_image_ids()} for model in models]
    used = parts[0] if parts else set()
    left = [name for name in names if name not in used]
    if not left:
        return {}
    partners: dict[str, dict[str, int]] = defaultdict(dict)
    with opened(database) as db:
        images = {image.image_id: image.name for image in db.read_all_images()}
        features = {name: db.num_keypoints_for_image(i) for i, name in images.items()}
        pairs, counts = db.read_two_view_geometry_num_inliers()
    for pair, inliers in zip(pairs, counts, strict=True):
        a, b = (images[i] for i in pycolmap.pair_id_to_image_pair(pair))
        if inliers >= LEAST_INLIERS:
            partners[a][b] = partners[b][a] = int(inliers)
    return {name: _why(name, features.get(name, 0), partners.get(name, {}), parts) for name in left}


def sentence(why: Mapping[str, str]) -> str:
    """Return the photographs and the reasons, those of one reason together."""
    by_reason: dict[str, list[str]] = defaultdict(list)
    for name, reason in why.items():
        by_reason[reason].append(name)
    return "; ".join(f"{', '.join(names)} ({reason})" for reason, names in by_reason.items())


def _why(name: str, count: int, met: Mapping[str, int], parts: Sequence[set[str]]) -> str:
    """Return why a photograph with so many features and verified matches did not register."""
    if count == 0:
        return "no features: it does not open, or shows nothing"
    few = f"only {count} features: blurred, dark or without texture"
    if not met:
        return few if count < FEW_FEATURES else "matches no other photograph"
    other = next((part for part in parts[1:] if name in part), None)
    if other is not None:
        return f"in a part of {len(other)} photographs that shares too little with the rest"
    here = {other: inliers for other, inliers in met.items() if parts and other in parts[0]}
    if not here:
        return "matches only photographs that did not register either"
    if count < FEW_FEATURES:
        return few
    best = max(here, key=lambda other: here[other])
    few = f"{here[best]} matches with {best}, its best of {len(here)}"
    return f"{few}: too few of them are points that others see too"
