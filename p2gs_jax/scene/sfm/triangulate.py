"""Seed points and tracks for views whose poses are known: SIFT, matching, triangulation."""

from __future__ import annotations

import dataclasses
import functools
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from p2gs_jax.errors import UserError
from p2gs_jax.scene.cache import Report, cached_folder, file_fingerprints
from p2gs_jax.scene.colmap import read_model, tracks_of
from p2gs_jax.scene.sfm.features import extract, match, opened, pairs_by_pose, quiet_colmap
from p2gs_jax.types import Scene, View

# Photographs with at least this many pixels along their longer side are not enlarged for SIFT
# (nerf_fox: 53 s and 12,017 points become 15 s and 5,449); exposures and dense seeds need no more.
LONG_ENOUGH = 800
LINKS = "photographs"


def triangulate(
    scene: Scene, work_dir: Path | None, report: Report, *, only_training: bool = False
) -> Scene:
    """Return the scene of posed views with points and tracks, none where nothing matches.

    `work_dir` keeps the result under `triangulated/`. Raises UserError: there is only one view, or
    a photograph cannot be read.
    """
    views = tuple(scene.training_views) if only_training else scene.views
    if len(views) < 2:
        why = f"no point could be triangulated from the poses in {scene.root}"
        fix = "check that there are several photographs, that they are sharp, and that the poses "
        raise UserError(why, fix=fix + "are theirs")
    key = {
        "pycolmap": pycolmap.__version__,
        "files": file_fingerprints([view.image_path for view in views]),
        "cameras": [
            [view.name, view.viewmat.tolist(), view.K.tolist(), *_lens(view)] for view in views
        ],
    }
    build = functools.partial(_build, views=views, report=report)
    with cached_folder(work_dir, "triangulated", key, build) as folder:
        model = read_model(folder)
        tracks = tracks_of(model, scene.views)
    if tracks is None:
        return scene
    report(f"triangulated {len(model.xyz)} points with {len(tracks.xy)} observations")
    points = model.xyz.astype(np.float32)
    return dataclasses.replace(scene, points=points, point_colors=model.rgb, tracks=tracks)


def _build(folder: Path, views: Sequence[View], report: Report) -> None:
    quiet_colmap()
    names = [view.name for view in views]
    image_folder = _image_folder(views, folder)
    database = folder / "database.db"
    report(f"no seed points: detecting features in {len(views)} images")
    # Intrinsics are held fixed, so it does not matter that every image has its own camera.
    enlarge = max(max(view.width, view.height) for view in views) < LONG_ENOUGH
    mode = pycolmap.CameraMode.PER_IMAGE
    extract(database, image_folder, names, mode=mode, enlarge=enlarge)
    prior = _set_cameras(database, views)
    if unread := sorted({*names} - {image.name for image in prior.images.values()}):
        raise UserError(
            f"COLMAP reads {len(views) - len(unread)} of {len(views)} photographs; one that it "
            f"cannot read is {image_folder / unread[0]}.",
            fix="export those photographs again as PNG or JPEG, or remove them from the scene",
        )
    pairs = pairs_by_pose(names, np.stack([view.viewmat for view in views]))
    n = len(views) * (len(views) - 1) // 2 if pairs is None else len(pairs)
    report(f"matching {n} image pairs")
    match(database, pairs)
    report("triangulating")
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    given = (prior, database, image_folder, folder)
    model = pycolmap.triangulate_points(*given, refine_intrinsics=False, options=options)
    if not model.points3D:
        # COLMAP takes no point that two photographs alone show; of two there are no others.
        options.triangulation.ignore_two_view_tracks = False
        model = pycolmap.triangulate_points(*given, refine_intrinsics=False, options=options)
    model.write(folder)
    database.unlink()  # large, and not needed again
    shutil.rmtree(folder / LINKS, ignore_errors=True)


def _set_cameras(database: Path, views: Sequence[View]) -> pycolmap.Reconstruction:
    """Overwrite the guessed cameras in the database; return a model of the known poses."""
    known = {view.name: view for view in views}
    reconstruction = pycolmap.Reconstruction()
    with opened(database) as db:
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
    """Return COLMAP's name of the lens model, and as many coefficients as it has."""
    if view.distortion is None:
        return "OPENCV", (0.0,) * 4
    held = view.distortion.coefficients
    if view.distortion.model == "fisheye":
        return "OPENCV_FISHEYE", held
    if len(held) == 4:
        return "OPENCV", held
    return "FULL_OPENCV", (*held, 0.0, 0.0, 0.0)[:8]


def _image_folder(views: Sequence[View], folder: Path) -> Path:
    """Return the folder that the names of photographs are relative to.

    Where there is none (KITTI's `image_02/data` belongs to camera `image_02`), one of links is
    made.
    """
    before = {str(view.image_path).removesuffix(view.name) for view in views}
    if len(before) == 1:
        return Path(before.pop() or ".")
    for view in views:
        link = folder / LINKS / view.name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(view.image_path.resolve())
    return folder / LINKS
