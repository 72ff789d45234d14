"""Names of cameras: photographs of one camera share a lens and its photometric model."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import count, islice
from pathlib import PurePosixPath

from p2gs_jax.config import CameraBy
from p2gs_jax.scene.convert.readers import read_exif_camera
from p2gs_jax.types import View


def parent_of(name: str) -> str:
    """Return the folders in the relative name of an image, or an empty string."""
    return PurePosixPath(name).parent.as_posix().removeprefix(".")


def numbered(views: Sequence[View]) -> list[View]:
    """Return views whose `camera`, here a description of the lens, is replaced by a number."""
    numbers = {lens: k for k, lens in enumerate(dict.fromkeys(view.camera for view in views))}
    return [replace(view, camera=str(numbers[view.camera])) for view in views]


def name_cameras(views: Sequence[View], by: CameraBy) -> tuple[View, ...]:
    """Return views with the names of their cameras; `views` have the model's camera ids instead.

    `auto` separates photographs by folder, by the model's camera, and by make, model and lens in
    EXIF. The model's cameras and EXIF count only if at least half of the photographs share their
    value with another one; COLMAP may write a camera for each photograph.
    """
    folders = models = devices = [""] * len(views)
    if by in ("auto", "folder"):
        folders = [parent_of(view.name) for view in views]
    if by in ("auto", "model"):
        models = [view.camera for view in views]
    if by in ("auto", "exif"):
        devices = [read_exif_camera(view.image_path) for view in views]
    if by == "auto":
        models, devices = _shared(models, folders), _shared(devices, folders)
    named = devices if by == "exif" else models
    bases = [folder or name or "0" for folder, name in zip(folders, named, strict=True)]
    keys = list(zip(models, devices, strict=True))
    parts: dict[str, dict[tuple, str]] = defaultdict(dict)
    for base, key in dict.fromkeys(zip(bases, keys, strict=True)):
        # Another folder may have the name of a part.
        free = (name for n in count(1) if (name := f"{base} {n}") not in bases)
        parts[base][key] = next(islice(free, len(parts[base]), None))
    return tuple(
        replace(v, camera=base if len(parts[base]) == 1 else parts[base][key])
        for v, base, key in zip(views, bases, keys, strict=True)
    )


def _shared(keys: list[str], folders: Sequence[str]) -> list[str]:
    """Return keys, or empty ones if most photographs share their key with no other."""
    counts = Counter(zip(folders, keys, strict=True))
    shared = sum(n for n in counts.values() if n > 1)
    return keys if 2 * shared >= len(keys) else [""] * len(keys)
