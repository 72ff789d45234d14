"""From a folder on disk to a `Scene`: its format is recognised; masks, EXIF and split are added."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from p2gs_jax.config import DataConfig, FitConfig
from p2gs_jax.core.text import first_few
from p2gs_jax.errors import UserError, broken
from p2gs_jax.options import check_values
from p2gs_jax.scene import transforms
from p2gs_jax.scene.colmap import CUT, find_deeper_model, find_model, load_colmap
from p2gs_jax.scene.convert.convert import convert_photographs, converted_views, with_originals
from p2gs_jax.scene.convert.icc import colour_notes
from p2gs_jax.scene.convert.readers import exif_evs
from p2gs_jax.scene.drives import read_drive
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.drives.recording import Recording
from p2gs_jax.scene.files import Report, images_and_maps, is_panorama, list_images
from p2gs_jax.scene.hdr_sets import exposure_times, with_all_exposures, with_raw_settings
from p2gs_jax.scene.masks import attach_masks, image_folder_of, with_alpha
from p2gs_jax.scene.pixels.store import ImageStore, camera_at, size_at
from p2gs_jax.scene.seeds import FEWEST, with_random_seeds
from p2gs_jax.scene.split import lists_beside, split_as_listed, split_scene
from p2gs_jax.scene.video import VIDEO_SUFFIXES, read_video
from p2gs_jax.types import Scene

__all__ = ["ImageStore", "camera_at", "load_scene", "size_at"]


def load_scene(
    root: Path, cfg: DataConfig, work_dir: Path | None = None, report: Report = lambda message: None
) -> Scene:
    """Read a scene; the files in the folder tell its format.

    `cfg.format` names the format, or the first of these is read: a COLMAP model in `sparse/0`,
    `sparse` or the folder itself; `transforms.json` (`root` may be this file);
    `transforms_train.json` with one file for each other part of the split; LLFF's
    `poses_bounds.npy`; a COLMAP model in a deeper folder; a drive of a known data set (`drives`);
    photographs in `images/` or the folder itself, or a video. Structure from motion then finds the
    cameras of photographs and videos. Poses without points get triangulated points, or random ones
    if fewer than `FEWEST` are found. Views are sorted by name. `work_dir`, in the folder of
    results, keeps long computations for a resume. Raises UserError: there is no scene, a file is
    broken, or results would be written among photographs (the message names the file); or a number
    in `cfg` is out of its range.
    """
    check_values(FitConfig(data=cfg))
    found = find_scene(root, cfg, report)
    if isinstance(found, Recording):
        scene = assemble(found, cfg, work_dir, report)
    elif isinstance(found, PhotographsAlone | Path):
        # This import is local, as the one below: scenes with cameras and points need no COLMAP.
        from p2gs_jax.scene.sfm.map import load_images

        notes: tuple[str, ...] = ()
        if isinstance(found, Path):
            photographs = read_video(found, cfg, work_dir, report)
        else:
            notes = found.notes
            if work_dir is not None:
                check_apart(work_dir.parent, found, _searches_below(found.folder, root, cfg))
            photographs = convert_photographs(found.folder, found.paths, work_dir, report)
        folder, paths = photographs.folder, photographs.paths
        auto = "sequence" if isinstance(found, Path) else "auto"
        scene = load_images(Path(root), folder, paths, cfg, work_dir, report, auto)
        scene = with_originals(scene, photographs)
        scene = dataclasses.replace(scene, notes=(*scene.notes, *notes))
    else:
        scene = found
    listed = scene.split_by is not None or cfg.split is not None
    # Masks and EXIF belong to the original photographs, alpha to the converted ones.
    scene = converted_views(with_masks_and_split(scene, cfg), work_dir, report)
    scene = with_alpha(scene, cfg)
    if len(scene.points) == 0:
        from p2gs_jax.scene.sfm.map import triangulate

        # If the user or the data set lists the held-out views, these give no seeds either.
        scene = triangulate(scene, work_dir, report, only_training=listed)
        if len(scene.points) < FEWEST:
            scene = with_random_seeds(scene)
    return scene


def check_apart(out: Path, found: PhotographsAlone, below: bool = False) -> None:
    """Raise UserError if results would be found as photographs, `below` also in subfolders."""
    holding = {path.resolve() for path in (found.folder, *(p.parent for p in found.paths))}
    place = out.resolve()
    if not holding.isdisjoint((place, *place.parents) if below else (place,)):
        why = f"--out {out} holds the photographs or lies among them, and pictures of results "
        why += "would join them."
        raise UserError(why, fix="name another folder with --out")


def with_masks_and_split(scene: Scene, cfg: DataConfig) -> Scene:
    """Return a scene with the masks of its views, EXIF exposures and the split.

    Raises UserError: the number of held-out views is impossible, or a list of them is wrong.
    """
    views, mask_notes = attach_masks(scene)
    paths = [view.image_path for view in views]
    both = zip(views, exif_evs(paths, [view.camera for view in views]), strict=True)
    # Exposures that a data set states take precedence.
    views = tuple(dataclasses.replace(v, exif_ev=ev) if v.exif_ev is None else v for v, ev in both)
    notes = (*scene.notes, *mask_notes, *colour_notes(paths))
    scene = dataclasses.replace(scene, views=views, notes=notes)
    return split_scene(scene, cfg)


class PhotographsAlone(NamedTuple):
    """Photographs without cameras: sorted paths, and the folder to which names are relative."""

    folder: Path
    paths: list[Path]
    maps: Sequence[Path] = ()  # pictures that count as depth maps or normal maps

    @property
    def notes(self) -> tuple[str, ...]:
        """A note on `maps`, if there are any: brackets may be called dark, normal and bright."""
        names = first_few([path.relative_to(self.folder).as_posix() for path in self.maps])
        note = f"{len(self.maps)} of the pictures count as depth maps or normal maps by the names "
        note += f"of their folders: {names}. If they are photographs, rename the folders."
        return (note,) if self.maps else ()


def find_scene(
    root: Path, cfg: DataConfig, report: Report = lambda message: None
) -> Scene | Recording | PhotographsAlone | Path:
    """Return the scene of a folder in the order of `load_scene`, without long computations.

    A Path names a video. Raises UserError: there is no scene, a file is broken, or an option has no
    effect on such a scene; the message names the file.
    """
    found = _found(Path(root), cfg, report)
    drive, video = isinstance(found, Recording), isinstance(found, Path)
    without_cameras = video or isinstance(found, PhotographsAlone)
    for kind, is_this, names in (
        ("a drive", drive, ("drive", "cameras", "frames", "lidar", "ego_mask")),
        ("a video", video, ("every", "max_frames")),
        ("a video or photographs without cameras", without_cameras, ("matching",)),
        ("a scene of photographs", not (drive or video), ("images",)),
    ):
        given = [name for name in names if getattr(cfg, name) != getattr(DataConfig(), name)]
        if given and not is_this:
            option = given[0].replace("_", "-")
            raise UserError(
                f"{root} is not {kind}, which --data.{option} is for.", fix="leave it out"
            )
    return found


def _found(
    root: Path, cfg: DataConfig, report: Report
) -> Scene | Recording | PhotographsAlone | Path:
    """Return the scene of a folder, whatever the options of other kinds of scenes."""
    if not root.exists():
        raise broken(root, "does not exist", "check the path of the scene")
    if root.is_file():
        if root.suffix.lower() in VIDEO_SUFFIXES:
            return root
        if root.suffix.lower() != ".json":
            fix = "name the folder of the scene, its transforms.json, or a video"
            raise broken(root, "is neither a transforms.json nor a video", fix)
        return transforms.load_transforms(root, root, cfg)
    model = find_model(root)
    if model is not None and cfg.format in (None, "colmap"):
        return _read_colmap(root, model, cfg)
    if (root / "transforms.json").is_file() and cfg.format in (None, "transforms"):
        return transforms.load_transforms(root, root / "transforms.json", cfg)
    if (root / "transforms_train.json").is_file() and cfg.format in (None, "blender"):
        return transforms.load_blender(root, cfg)
    if transforms.llff_table(root) and cfg.format in (None, "llff"):
        return transforms.load_llff(root, cfg)
    model = find_deeper_model(root) if cfg.format in (None, "colmap") else None
    if model is not None:
        return _read_colmap(root, model, cfg)
    recording = read_drive(root, cfg, report)
    if recording is not None:
        return recording
    if cfg.format not in (None, "images"):
        fix = "leave out --data.format, or name the folder that holds one"
        raise broken(root, f"holds no scene in the format {cfg.format!r}", fix)
    return _photographs_alone(root, cfg)


def _read_colmap(root: Path, folder: Path, cfg: DataConfig) -> Scene:
    scene, notes = load_colmap(root, folder, cfg), []
    if folder not in (root, root / "sparse", root / "sparse" / "0"):
        notes.append(f"The cameras come from the COLMAP model in {folder}.")
    if not len(scene.points):
        notes.append(f"The COLMAP model {folder} has no points: points are triangulated.")
    times, time_notes = transforms.table_times(root, image_folder_of(scene.views[0]))
    scene = dataclasses.replace(scene, notes=(*scene.notes, *notes, *time_notes))
    source = root / (transforms.LLFF_FILES[0] if times else "exposure.json")
    if not times and source.is_file():
        times = exposure_times(source)
    scene = (
        with_all_exposures(scene, times, source, cfg) if times else with_raw_settings(root, scene)
    )
    lists = lists_beside(folder, root) if cfg.split is None and cfg.test_every else None
    if lists is None:
        return scene
    return split_as_listed(scene, lists, allow_missing=cfg.allow_missing)


def _photographs_alone(root: Path, cfg: DataConfig) -> PhotographsAlone:
    folders = [root / cfg.images] if cfg.images is not None else [root / "images", root]
    for folder in folders:
        paths, maps = images_and_maps(folder, recursive=_searches_below(folder, root, cfg))
        for path in paths:
            if is_panorama(path):
                raise broken(path, "shows a whole sphere, and is not a pinhole photograph", CUT)
        if paths:
            return PhotographsAlone(folder, paths, maps)
    looked = ", ".join(str(folder) for folder in folders)
    fix = "name the folder that holds one of these"
    film = next((p for p in sorted(root.iterdir()) if p.suffix.lower() in VIDEO_SUFFIXES), None)
    fix = fix if film is None else f"name the video itself, {film}"
    if cfg.images is None:
        below = sorted(d.name for d in root.iterdir() if list_images(d, recursive=False))
        if below:
            fix += f"; photographs are in subfolders {', '.join(below[:3])}"
            fix += ": if each folder is a camera, add --data.images ."
    why = f"no scene in {root}: there is no COLMAP model (cameras, images and points3D as .bin or "
    why += ".txt, in sparse/0, sparse or the folder itself), no transforms.json or "
    why += "transforms_train.json, no poses_bounds.npy, no drive of a known data set, and no "
    why += f"photographs (looked in {looked})"
    raise UserError(why, fix=fix)


def _searches_below(folder: Path, root: Path, cfg: DataConfig) -> bool:
    """Return whether photographs are searched in subfolders too.

    Subfolders of the root may hold masks or results of other runs: they are searched only if the
    user names the root.
    """
    return folder != Path(root) or cfg.images is not None
