"""Sets with several exposures of one pose: exposure times, shared poses, and true radiance.

    HDR-NeRF, synthetic  a frame NAME of `transforms_train.json` stands for NAME_0.png, NAME_1.png,
                         ...; `exposure_train.json` has their times, `train_hdr/hdr_000.exr` the
                         true radiance; likewise for `test`
    HDR-NeRF, real       `poses_bounds_exps.npy` has a row for each photograph of `input_images/`
    HDR-GS               the same table, or none, beside a COLMAP model with one photograph of each
                         pose, NUMBER_0.png; true radiance in `exr/NUMBER.exr`
    GaussHDR             such a model; `exposure.json` has the times of PART_NUMBER_0.png, PART is
                         `train` or `test`; true radiance in `images_hdr/PART_hdr_000.exr`
    RawNeRF              `raw/NAME.json`, exiftool's settings, beside a COLMAP model

The layouts follow the readers in github.com/xhuangcv/hdr-nerf, caiyuanhao1998/HDR-GS,
LiuJF1226/GaussHDR and google-research/multinerf. Times are kept in `View.exif_ev`.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene import files
from p2gs_jax.scene.exposures import plain_name, row_finder
from p2gs_jax.scene.masks import image_folder_of
from p2gs_jax.types import Scene, Tracks, View

_FIX = "correct the file, or remove it to read the scene without exposures"
_LAST_NUMBER = re.compile(r"_\d+$")
_PART = re.compile(r"(train|test)[_-]")


def exposure_times(path: Path) -> dict[str, float]:
    """Return the exposure times in a file `exposure*.json` by the names of photographs.

    3DGS writes files of this name with matrices, which state no times: the result is empty then.
    Raises UserError: the file is broken, or a time is not a positive number.
    """
    data = files.read_json(path, _FIX)
    if not isinstance(data, dict):
        raise broken(path, "does not map names of photographs to exposure times", _FIX)
    if data and all(isinstance(value, list) for value in data.values()):
        return {}
    for name, value in data.items():
        number = _number(value)
        if number is None or number <= 0:
            why = f"the exposure of {name} is {value!r}, not a positive number"
            raise broken(f"{path}:", why, _FIX)
        data[name] = number
    return data


def _number(value: object) -> float | None:
    """Return the finite number that a value of JSON states, such as 0.5 or "1/60", or None."""
    try:
        number = float(Fraction(value) if isinstance(value, str) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if np.isfinite(number) and not isinstance(value, bool) else None


def pose_name(name: str) -> str:
    """Return the name that all photographs of a pose share: `a/r_0_4.png` gives `a/r_0`."""
    return _LAST_NUMBER.sub("", PurePosixPath(plain_name(name)).with_suffix("").as_posix())


def by_pose(names: Sequence[str]) -> dict[str, list[str]]:
    """Return the names of photographs by the name of their pose."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        found[pose_name(name)].append(plain_name(name))
    return found


def with_times(views: Sequence[View], times: Mapping[str, float], source: Path) -> tuple[View, ...]:
    """Return views with the exposure times of the file `source`.

    Raises UserError: a name is ambiguous, or no name belongs to a view.
    """
    row_of, out = row_finder(views, source), list(views)
    for name, time in times.items():
        row = row_of(name)
        if row is not None:
            out[row] = replace(out[row], exif_ev=float(np.log2(time)))
    if all(after is before for after, before in zip(out, views, strict=True)):
        why = f"names none of the {len(views)} photographs, for example {views[0].name}"
        raise broken(source, why, _FIX)
    return tuple(out)


def with_all_exposures(
    scene: Scene, times: Mapping[str, float], source: Path, cfg: DataConfig
) -> Scene:
    """Return a scene in which every photograph of a pose is a view with its exposure time.

    A photograph that the model lacks gets the pose and the observations of the first one of its
    pose. Names that begin with `train` or `test` decide the split. Raises UserError: as
    `with_times` does, or photographs are missing or have another aspect ratio than their pose's.
    """
    folder = image_folder_of(scene.views[0])
    present = {view.name for view in scene.views}
    first = {pose_name(view.name): row for row, view in reversed([*enumerate(scene.views)])}
    listed = {n: first[pose] for pose, ns in by_pose([*times]).items() if pose in first for n in ns}
    added = {name: row for name, row in listed.items() if name not in present}
    missing = [name for name in added if not (folder / name).is_file()]
    notes = files.check_missing(missing, len(times), source, cfg, folder)
    sources, views = list(range(len(scene.views))), list(scene.views)
    for name, row in added.items():
        if name in missing:
            continue
        like, path = scene.views[row], folder / name
        K, width, height = files.at_file_size(path, like.K, (like.width, like.height), source)
        views.append(replace(like, name=name, image_path=path, K=K, width=width, height=height))
        sources.append(row)
    order = sorted(range(len(views)), key=lambda row: views[row].name)
    if len(views) > len(scene.views):
        count = len(views) - len(scene.views)
        notes.append(f"{count} more photographs of the model's poses are named by {source.name}.")
    views = with_times([views[row] for row in order], times, source)
    tracks = _copied(scene.tracks, [sources[row] for row in order])
    found = [_PART.match(PurePosixPath(view.name).name) for view in views]
    parts = [part and part[1] for part in found]
    split_by = scene.split_by
    if split_by is None and {*parts} == {"train", "test"}:
        views = tuple(replace(v, split=part) for v, part in zip(views, parts, strict=True))
        split_by = "names that begin with train or test"
    notes = (*scene.notes, *notes)
    return replace(scene, views=views, tracks=tracks, notes=notes, split_by=split_by)


def _copied(tracks: Tracks | None, sources: Sequence[int]) -> Tracks | None:
    """Return the tracks of new views; `sources` are the old views whose observations they get."""
    if tracks is None:
        return None
    picked = [np.flatnonzero(tracks.view_indices == row) for row in sources]
    rows = np.repeat(np.arange(len(sources)), [len(at) for at in picked]).astype(np.int32)
    at = np.concatenate(picked)
    return Tracks(rows, tracks.point_indices[at], tracks.xy[at])


def with_raw_settings(root: Path, scene: Scene) -> Scene:
    """Return a scene with the exposures in exiftool's files in `raw/`, if all views have them.

    Raises UserError: such a file is broken.
    """
    places = [root / "raw", root / "raw" / "train"]
    paths = [
        next((p for place in places if (p := place / f"{Path(v.name).stem}.json").is_file()), None)
        for v in scene.views
    ]
    evs = [None if path is None else _raw_ev(path) for path in paths]
    if None in evs:
        return scene
    views = tuple(replace(v, exif_ev=ev) for v, ev in zip(scene.views, evs, strict=True))
    note = f"The exposures of {len(views)} photographs are those of {places[0]}."
    raw = [path.with_suffix(".dng") for path in paths if path is not None]
    if any(
        path.is_file() and path != view.image_path for path, view in zip(raw, views, strict=True)
    ):
        note += " Its raw photographs are read with --images raw."
    return replace(scene, views=views, notes=(*scene.notes, note))


def _raw_ev(path: Path) -> float | None:
    """Return log2(time * ISO / f-number^2) of a file of exiftool; None: it states no time."""
    data: Any = files.read_json(path, _FIX)
    data = data[0] if isinstance(data, list) and data else data
    if not isinstance(data, dict):
        raise broken(path, "holds no settings", _FIX)
    time = _number(data.get("ExposureTime", data.get("ShutterSpeed")))
    iso, number = _number(data.get("ISO", 100)), _number(data.get("FNumber", 1))
    if time is None:
        return None
    if not (time > 0 and iso and iso > 0 and number and number > 0):
        raise broken(path, "states an impossible ShutterSpeed, ISO or FNumber", _FIX)
    return float(np.log2(time * iso / number**2))


def true_radiance(root: Path, view: View) -> Path | None:
    """Return the file with the true radiance of a view's pose in an HDR set, or None."""
    name = pose_name(view.image_path.name)
    part, number = name.split("_")[0], name.rsplit("_", 1)[-1]
    if not number.isdecimal():
        return None
    places = (
        root / "images_hdr" / f"{part}_hdr_{int(number):03d}.exr",
        root / f"{view.image_path.parent.name}_hdr" / f"hdr_{int(number):03d}.exr",
        root / "exr" / f"{number}.exr",
    )
    return next((path for path in places if path.is_file()), None)
