"""Cameras, points and tracks from photographs alone, or points and tracks from known poses."""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.config import DataConfig, Matching
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.colmap import pycolmap
from p2gs_jax.core.text import count_of
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene import files
from p2gs_jax.scene.cameras import parent_of
from p2gs_jax.scene.colmap import load_colmap, read_model, tracks_of
from p2gs_jax.scene.convert.readers import read_exif_camera
from p2gs_jax.scene.lens import undistort_points
from p2gs_jax.scene.rigid import require_axes
from p2gs_jax.scene.sfm import features
from p2gs_jax.types import Scene, View

FEATURES, REASONS = "features", "left_out.json"
# A photograph with fewer features seldom gets a pose.
FEW_FEATURES = 100
# Matches farther than this from the epipolar line contradict the poses, pixels.
EPIPOLAR_PX = 4.0
# COLMAP does not verify a pair with fewer inliers.
LEAST_INLIERS = 15
# Photographs with at least this longer side, pixels, are not enlarged for SIFT. For nerf_fox, 53 s
# and 12,017 points become 15 s and 5,449, enough for exposures and dense seeds.
LONG_ENOUGH = 800
LINKS = "photographs"  # a folder
_ADVICE = (
    "photographs register if they are sharp, show texture, and overlap by more than half with at "
    "least two others from different positions"
)


def load_images(
    root: Path,
    image_folder: Path,
    paths: Sequence[Path],
    cfg: DataConfig,
    work_dir: Path | None,
    report: files.Report,
    auto: Matching = "auto",
) -> Scene:
    """Run COLMAP's structure from motion on the photographs in a folder; read the largest model.

    `work_dir` caches the model in `sfm/`, for the same photographs, and features and matches in
    `features/`, also if photographs are added. `auto` selects the pairs if the user does not.
    Raises UserError: there are fewer than two photographs, one is not an image, or none is
    registered.
    """
    names = [path.relative_to(image_folder).as_posix() for path in paths]
    if len(paths) < 2:
        why = f"holds {count_of(len(paths), 'image')}; a reconstruction needs at least two"
        fix = "add photographs of the same place from different positions"
        raise broken(root, why, fix)
    groups: dict[tuple, list[str]] = defaultdict(list)
    for path, name in zip(paths, names, strict=True):
        exif = read_exif_camera(path, zoom=True) if cfg.camera_by in ("auto", "exif") else ""
        folder = parent_of(name) if cfg.camera_by in ("auto", "folder") else ""
        groups[(files.image_size(path), exif, folder)].append(name)
    key: dict[str, Any] = {
        "pycolmap": pycolmap.__version__,
        "files": files.file_fingerprints(paths),
    }
    if cfg.camera_by != "auto":
        key["camera_by"] = cfg.camera_by
    if cfg.matching != "auto":
        key["matching"] = cfg.matching
    pairs = features.pairs_by_name(names, auto if cfg.matching == "auto" else cfg.matching)

    def build(folder: Path) -> None:
        kept = (folder if work_dir is None else work_dir) / FEATURES
        _build(folder, kept, root, image_folder, groups, pairs, report)

    with files.cached_folder(work_dir, "sfm", key, build) as folder:
        images = str(image_folder.resolve())
        scene = load_colmap(root, folder / "model", dataclasses.replace(cfg, images=images))
        why = json.loads((folder / REASONS).read_text())
    registered = {view.name for view in scene.views}
    left_out = [name for name in names if name not in registered]
    notes = scene.notes
    if left_out:
        known = {name: why.get(name, "for an unknown reason") for name in left_out}
        note = f"{len(left_out)} of {len(names)} images could not be registered and are not used: "
        notes = (*notes, f"{note}{sentence(known)}; {_ADVICE}")
    report(f"registered {len(registered)} of {len(names)} images, {len(scene.points)} points")
    return dataclasses.replace(scene, format="images", notes=notes)


def _build(
    folder: Path,
    kept: Path,
    root: Path,
    image_folder: Path,
    groups: Mapping[tuple, Sequence[str]],
    pairs: Sequence[features.Pair] | None,
    report: files.Report,
) -> None:
    """Write the largest model to a folder, and the reasons why photographs are not in it.

    The features are cached in `kept`; messages name `root`.
    """
    features.quiet_colmap()
    names = [name for group in groups.values() for name in group]
    database = features.kept_features(kept, image_folder, groups, report)
    features.match_kept(database, names, pairs, report)
    models_folder = folder / "models"
    models_folder.mkdir()
    registered, progress = 2, files.stage_progress(report, "mapping", len(names), "images")

    def on_next_image() -> None:
        nonlocal registered
        registered += 1
        progress(registered)

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    found = pycolmap.incremental_mapping(
        database, image_folder, models_folder, options=options, next_image_callback=on_next_image
    ).values()
    models = sorted(found, key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)
    why = reasons(database, names, models)
    if not models:
        none = f"none of the {len(names)} images of {root} could be registered"
        raise UserError(f"{none}: {sentence(why)}", fix=_ADVICE)
    (folder / "model").mkdir()
    models[0].write(folder / "model")
    write_json(folder / REASONS, why)
    shutil.rmtree(models_folder)


def reasons(
    database: Path, names: Sequence[str], models: Sequence[pycolmap.Reconstruction]
) -> dict[str, str]:
    """Return the reasons why photographs are not in the first model, from the database."""
    parts = [{model.image(i).name for i in model.reg_image_ids()} for model in models]
    used = parts[0] if parts else set()
    left = [name for name in names if name not in used]
    if not left:
        return {}
    partners: dict[str, dict[str, int]] = defaultdict(dict)
    with pycolmap.Database.open(database) as db:
        images = {image.image_id: image.name for image in db.read_all_images()}
        found = {name: db.num_keypoints_for_image(i) for i, name in images.items()}
        pairs, counts = db.read_two_view_geometry_num_inliers()
    for pair, inliers in zip(pairs, counts, strict=True):
        a, b = (images[i] for i in pycolmap.pair_id_to_image_pair(pair))
        if inliers >= LEAST_INLIERS:
            partners[a][b] = partners[b][a] = int(inliers)
    return {name: _why(name, found.get(name, 0), partners.get(name, {}), parts) for name in left}


def sentence(why: Mapping[str, str]) -> str:
    """Return photographs and their reasons as text, grouped by reason."""
    by_reason: dict[str, list[str]] = defaultdict(list)
    for name, reason in why.items():
        by_reason[reason].append(name)
    return "; ".join(f"{', '.join(names)} ({reason})" for reason, names in by_reason.items())


def _why(name: str, count: int, matches: Mapping[str, int], parts: Sequence[set[str]]) -> str:
    """Return why a photograph with `count` features and these matches is not in the first part."""
    if count == 0:
        return "no features: it does not open, or shows nothing"
    few = f"only {count} features: blurred, dark or without texture"
    if not matches:
        return few if count < FEW_FEATURES else "matches no other photograph"
    other = next((part for part in parts[1:] if name in part), None)
    if other is not None:
        return f"in a part of {len(other)} photographs that shares too little with the rest"
    registered = {other: n for other, n in matches.items() if parts and other in parts[0]}
    if not registered:
        return "matches only photographs that did not register either"
    if count < FEW_FEATURES:
        return few
    best = max(registered, key=lambda other: registered[other])
    most = f"{registered[best]} matches with {best}, its best of {len(registered)}"
    return f"{most}: too few of them are points that other photographs see"


def triangulate(
    scene: Scene, work_dir: Path | None, report: files.Report, *, only_training: bool = False
) -> Scene:
    """Return the scene of posed views with triangulated points and tracks, if photographs match.

    `only_training` leaves out the held-out views. `work_dir` caches the result in `triangulated/`.
    Raises UserError: there is only one view, or a photograph cannot be read.
    """
    views = tuple(scene.training_views) if only_training else scene.views
    if len(views) < 2:
        why = f"no point could be triangulated from the poses in {scene.root}"
        fix = "check that there are several sharp photographs, and that the poses belong to them"
        raise UserError(why, fix=fix)
    key = {
        "pycolmap": pycolmap.__version__,
        "files": files.file_fingerprints([view.image_path for view in views]),
        "cameras": [
            [view.name, view.viewmat.tolist(), view.K.tolist(), *_lens(view)] for view in views
        ],
    }
    build = functools.partial(_triangulate, views=views, root=scene.root, report=report)
    with files.cached_folder(work_dir, "triangulated", key, build) as folder:
        model = read_model(folder)
        tracks = tracks_of(model, scene.views)
    if tracks is None:
        return scene
    report(f"triangulated {len(model.xyz)} points with {len(tracks.xy)} observations")
    points = model.xyz.astype(np.float32)
    return dataclasses.replace(scene, points=points, point_colors=model.rgb, tracks=tracks)


def _triangulate(folder: Path, views: Sequence[View], root: Path, report: files.Report) -> None:
    features.quiet_colmap()
    names = [view.name for view in views]
    image_folder = _image_folder(views, folder)
    database = folder / "database.db"
    report(f"no seed points: detecting features in {len(views)} images")
    # Intrinsics are fixed, so that every image may have a separate camera.
    enlarge = max(max(view.width, view.height) for view in views) < LONG_ENOUGH
    mode = pycolmap.CameraMode.PER_IMAGE
    features.extract(database, image_folder, names, mode=mode, enlarge=enlarge)
    prior = _set_cameras(database, views)
    if unread := sorted({*names} - {image.name for image in prior.images.values()}):
        why = f"COLMAP reads only {len(views) - len(unread)} of {len(views)} photographs; "
        why += f"it cannot read {image_folder / unread[0]}."
        fix = "export those photographs again as PNG or JPEG, or remove them from the scene"
        raise UserError(why, fix=fix)
    pairs = features.pairs_by_pose(names, np.stack([view.viewmat for view in views]))
    n = len(views) * (len(views) - 1) // 2 if pairs is None else len(pairs)
    report(f"matching {n} image pairs")
    features.match(database, pairs)
    require_axes(views, functools.partial(agreement, database), root)
    report("triangulating")
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    arguments = (prior, database, image_folder, folder)
    model = pycolmap.triangulate_points(*arguments, refine_intrinsics=False, options=options)
    if not model.points3D:
        # COLMAP omits points in only two photographs, that is, all points of a pair.
        options.triangulation.ignore_two_view_tracks = False
        model = pycolmap.triangulate_points(*arguments, refine_intrinsics=False, options=options)
    model.write(folder)
    database.unlink()  # large, and not needed again
    shutil.rmtree(folder / LINKS, ignore_errors=True)


def _set_cameras(database: Path, views: Sequence[View]) -> pycolmap.Reconstruction:
    """Overwrite COLMAP's guessed cameras in the database; return a model of the known poses."""
    known = {view.name: view for view in views}
    reconstruction = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as db:
        for image in db.read_all_images():
            view = known[image.name]
            camera = camera_of(view, image.camera_id)
            db.update_camera(camera)
            reconstruction.add_camera_with_trivial_rig(camera)
            pose = pycolmap.Rigid3d(view.viewmat[:3].astype(np.float64))
            ids = {"camera_id": image.camera_id, "image_id": image.image_id}
            posed = pycolmap.Image(name=image.name, **ids)
            reconstruction.add_image_with_trivial_frame(posed, pose)
    return reconstruction


def agreement(database: Path, views: Sequence[View]) -> float:
    """Return the share of verified matches that lie near the epipolar lines of the poses.

    It is 1 if there are fewer than `FEW_FEATURES` matches.
    """
    known = {view.name: view for view in views}
    near: list[np.ndarray] = []
    with pycolmap.Database.open(database) as db:
        views_of = {image.image_id: known[image.name] for image in db.read_all_images()}
        rays = {i: _rays(view, db.read_keypoints(i)[:, :2]) for i, view in views_of.items()}
        for pair, found in zip(*db.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            matches = found.inlier_matches
            if len(matches) < LEAST_INLIERS:
                continue
            relative = views_of[b].viewmat @ np.linalg.inv(views_of[a].viewmat.astype(np.float64))
            x, y, z = relative[:3, 3]
            E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
            first, second = rays[a][matches[:, 0]], rays[b][matches[:, 1]]
            line, other = first @ E.T, second @ E
            # Sampson's distance is in focal lengths; points must lie in front of both cameras.
            across = np.hypot(np.hypot(*line[:, :2].T), np.hypot(*other[:, :2].T))
            off = np.abs((second * line).sum(1)) / np.maximum(across, 1e-12)
            turned = first @ relative[:3, :3].T
            wide, far = np.cross(second, turned), np.cross(relative[:3, 3], second)
            depth = (wide * far).sum(1) / np.maximum((wide**2).sum(1), 1e-12)
            ahead = (depth > 0) & (depth * turned[:, 2] + z > 0)
            near.append(ahead & (off < EPIPOLAR_PX / views_of[a].K[0, 0]))
    matched = np.concatenate(near) if near else np.zeros(0, bool)
    return float(matched.mean()) if len(matched) >= FEW_FEATURES else 1.0


def _rays(view: View, xy: np.ndarray) -> np.ndarray:
    """Return rays [n 3] with depth 1 through pixels of a photograph."""
    straight = undistort_points(xy, view.K, view.distortion).astype(np.float64)
    return np.c_[(straight - view.K[:2, 2]) / view.K[[0, 1], [0, 1]], np.ones(len(xy))]


def camera_of(view: View, camera_id: int) -> pycolmap.Camera:
    """Return COLMAP's camera for a view."""
    model, coefficients = _lens(view)
    K = view.K.astype(np.float64)
    return pycolmap.Camera(
        camera_id=camera_id,
        model=model,
        width=view.width,
        height=view.height,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2], *coefficients],
        has_prior_focal_length=True,
    )


def _lens(view: View) -> tuple[str, tuple[float, ...]]:
    """Return COLMAP's name of the lens model, and its coefficients."""
    if view.distortion is None:
        return "OPENCV", (0.0,) * 4
    model, coefficients = view.distortion.model, view.distortion.coefficients
    if model != "radial":
        return "OPENCV_FISHEYE" if model == "fisheye" else model, coefficients
    if len(coefficients) == 4:
        return "OPENCV", coefficients
    return "FULL_OPENCV", (*coefficients, 0.0, 0.0, 0.0)[:8]


def _image_folder(views: Sequence[View], folder: Path) -> Path:
    """Return the folder to which the names of photographs are relative.

    If there is none (KITTI's `image_02/data` belongs to camera `image_02`), symbolic links in
    `folder` stand for the photographs.
    """
    before = {str(view.image_path).removesuffix(view.name) for view in views}
    if len(before) == 1:
        return Path(before.pop() or ".")
    for view in views:
        link = folder / LINKS / view.name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(view.image_path.resolve())
    return folder / LINKS
