"""Facts about a scene folder before a fit, for every format, without long computations."""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import count_of
from p2gs_jax.scene import PhotographsAlone, find_scene, with_masks_and_split
from p2gs_jax.scene.brackets import bracket_notes, brackets, names_of_brackets
from p2gs_jax.scene.convert.readers import exif_evs
from p2gs_jax.scene.drives.assemble import assemble, chosen_frames
from p2gs_jax.scene.drives.recording import Recording
from p2gs_jax.scene.files import Report, image_size
from p2gs_jax.scene.rigid import camera_centers, time_order
from p2gs_jax.scene.video import expected_frames, video_size
from p2gs_jax.types import Scene, View

# The largest number of labels of boxes that are listed; the others are counted together.
MOST_LABELS = 8


@dataclass(frozen=True)
class SurveyedCamera:
    """One physical camera, or photographs of one size if their cameras are unknown."""

    name: str
    photographs: int
    size: tuple[int, int]  # pixels
    focal: float | None = None  # pixels
    lens: str = ""
    ego_mask: float | None = None  # share of the picture that the car covers
    ev: tuple[float, float] | None = None  # range of log2(time ISO / N^2), stops up to a constant


@dataclass(frozen=True)
class Survey:
    """Facts about a scene: its format as in `DataConfig`, its cameras, and other facts in words."""

    format: str
    cameras: tuple[SurveyedCamera, ...]
    sentences: tuple[str, ...]

    @property
    def photographs(self) -> int:
        """Number of photographs."""
        return sum(camera.photographs for camera in self.cameras)


def survey(root: Path, cfg: DataConfig, report: Report = lambda message: None) -> Survey:
    """Return facts about a folder, read with the options of a fit; missing photographs are counted.

    Raises UserError as `find_scene` does, and if an image is broken or a table malformed.
    """
    cfg = dataclasses.replace(cfg, allow_missing=True)
    found = find_scene(root, cfg, report)
    alone = ("There are no cameras: structure from motion finds them when a fit starts.",)
    if isinstance(found, PhotographsAlone):
        names = [path.relative_to(found.folder).as_posix() for path in found.paths]
        notes = (*bracket_notes(names_of_brackets(names)), *found.notes, *alone)
        return Survey("images", _sizes(found), notes)
    if isinstance(found, Path):  # a video
        camera = SurveyedCamera("", expected_frames(found) or 0, video_size(found))
        return Survey("video", (camera,), alone)
    if isinstance(found, Recording):
        scene = with_masks_and_split(assemble(found, cfg, None, report, write_embedded=False), cfg)
        facts = _drive_facts(scene, found, cfg)
    else:
        scene = with_masks_and_split(found, cfg)
        facts = [f"{len(scene.points):,} points."] if len(scene.points) else []
        if scene.tracks is not None:
            facts.append(f"{len(scene.tracks.xy):,} observations of points.")
    if all(view.exif_ev is None for view in scene.views):
        facts.append("EXIF has no exposures.")
    facts += bracket_notes(brackets(scene.views))
    cameras = tuple(_camera(name, views) for name, views in _by_camera(scene).items())
    return Survey(scene.format, cameras, (*facts, *scene.notes))


def _by_camera(scene: Scene) -> dict[str, list[View]]:
    """Return the views of each camera in the order of time."""
    names = sorted({view.camera for view in scene.views})
    return {n: sorted((v for v in scene.views if v.camera == n), key=time_order) for n in names}


def _camera(name: str, views: Sequence[View]) -> SurveyedCamera:
    view, ev = views[0], _range([v.exif_ev for v in views])
    lens = "" if view.distortion is None else view.distortion.model
    car_share = None if view.ego_mask is None else float(view.ego_mask.mean())
    size = (view.width, view.height)
    return SurveyedCamera(name, len(views), size, float(view.K[0, 0]), lens, car_share, ev)


def _drive_facts(scene: Scene, found: Recording, cfg: DataConfig) -> list[str]:
    frames = len(chosen_frames(cfg.frames, sorted({p.frame for p in found.photographs})))
    by_camera = _by_camera(scene)
    centers = camera_centers(np.stack([v.viewmat for v in max(by_camera.values(), key=len)]))
    total = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    times = [view.time for view in scene.views if view.time is not None]
    missing = frames * len(by_camera) - len(scene.views)
    facts = [f"{count_of(frames, 'frame')}, {max(times) - min(times):.1f} s, {total:.1f} m driven."]
    if missing:
        facts.append(f"These frames lack {count_of(missing, 'photograph')}.")
    labels = Counter(thing.label for thing in scene.objects)
    if not labels:
        return [*facts, "There are no boxes."]
    moving = Counter(thing.label for thing in scene.objects if thing.moving)
    listed = [
        f"{count} {label}" + (f" ({moving[label]} moving)" if moving[label] else "")
        for label, count in labels.most_common(MOST_LABELS)
    ]
    rest = labels.total() - sum(count for _, count in labels.most_common(MOST_LABELS))
    listed += [f"and {rest} more"] if rest else []
    counts = f"Boxes: {labels.total()} tracked, {moving.total()} moving"
    return [*facts, f"{counts}: {', '.join(listed)}."]


def _range(values: Sequence[float | None]) -> tuple[float, float] | None:
    known = [v for v in values if v is not None]
    return (min(known), max(known)) if known else None


def _sizes(found: PhotographsAlone) -> tuple[SurveyedCamera, ...]:
    """Return one camera for each size of photographs, before their cameras are found."""
    by_size: dict[tuple[int, int], list[Path]] = defaultdict(list)
    for path in found.paths:
        by_size[image_size(path)].append(path)
    return tuple(
        SurveyedCamera("", len(paths), size, ev=_range(exif_evs(paths)))
        for size, paths in sorted(by_size.items(), key=lambda item: -len(item[1]))
    )
