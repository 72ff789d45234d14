"""Masks, which state the pixels that count: files beside photographs, and alpha channels."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from PIL import Image

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import first_few
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.files import (
    IMAGE_SUFFIXES,
    MASK_FOLDERS,
    files_below,
    name_without_mask,
    named_as_mask,
)
from p2gs_jax.types import Scene, View

RANDOM = "random"
NAMED_COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
# If training draws a random background, scores use this one, as 3DGS does.
SCORE_BACKGROUND = "white"
# Suffixes of files that never have an alpha channel.
_OPAQUE = frozenset({".jpg", ".jpeg", ".jfif", ".pgm", ".ppm"})


def attach_masks(scene: Scene) -> tuple[tuple[View, ...], list[str]]:
    """Return the views of a scene with the masks that lie beside its photographs, and notes."""
    found, unused = find_masks(scene.views, scene.root)
    masked = tuple(
        view if view.mask_path else dataclasses.replace(view, mask_path=mask)
        for view, mask in zip(scene.views, found, strict=True)
    )
    bare = [view.name for view in masked if view.mask_path is None]
    if len(bare) == len(masked):
        why = "but none has the name of a photograph: name each mask like its photograph"
        return masked, [f"{folder} holds {count} files, {why}" for folder, count in unused.items()]
    if not bare:
        return masked, []
    return masked, [f"{len(bare)} of {len(masked)} views have no mask: {first_few(bare)}"]


def find_masks(views: Sequence[View], root: Path) -> tuple[list[Path | None], dict[Path, int]]:
    """Return the mask of each view, or None, and the number of files in every folder of masks.

    A folder of masks (`MASK_FOLDERS`) lies beside the folder of the photographs, in it, or above it
    within the scene's root. A mask has the name of its photograph, in any case and with any suffix,
    and may have "mask" before or after it. A mask beside its photograph must have this word.
    """
    # The root may be the scene's .json.
    root = root if root.is_dir() else root.parent
    folders: dict[Path, dict[str, Path]] = {}
    folders_of = functools.cache(_mask_folders)
    found: list[Path | None] = []
    for view in views:
        found.append(None)
        for folder, name in _places(view, root, folders_of):
            if folder not in folders:
                folders[folder] = _masks_in(folder)
            if masks := folders[folder]:
                found[-1] = _exact(folder, name) or masks.get(name_without_mask(name))
                if found[-1] is not None:
                    break
    return found, {f: len(masks) for f, masks in folders.items() if masks and _holds_masks(f)}


def _holds_masks(folder: Path) -> bool:
    return folder.name.lower() in MASK_FOLDERS


def _mask_folders(place: Path) -> list[Path]:
    """Return the folders of masks in a folder, in the order of `MASK_FOLDERS`."""
    found = [p for p in place.iterdir() if _holds_masks(p) and p.is_dir()] if place.is_dir() else []
    return sorted(found, key=lambda p: (MASK_FOLDERS.index(p.name.lower()), p.name))


def _places(
    view: View, root: Path, folders_of: Callable[[Path], list[Path]]
) -> Iterator[tuple[Path, str]]:
    """Yield folders in which the mask of a view may lie, and its possible names there."""
    images, path = image_folder_of(view), view.image_path
    above = images.parents[1:] if root in images.parents else ()
    for place in (images.parent, images, *(p for p in above if p.is_relative_to(root))):
        parts = path.relative_to(place).parts
        for k in range(len(parts) - len(Path(view.name).parts), -1, -1):
            for folder in folders_of(place):
                yield folder, "/".join(parts[k:])
    yield from ((folder, view.name) for folder in folders_of(root))
    yield path.parent, path.name


def _masks_in(folder: Path) -> dict[str, Path]:
    """Return the masks in a folder by `name_without_mask`; other files are left out."""
    all_masks = _holds_masks(folder)
    files = files_below(folder) if all_masks else folder.glob("*")
    files = (p for p in files if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != ".")
    files = (p for p in files if all_masks or named_as_mask(p.name))
    return {name_without_mask(p.relative_to(folder).as_posix()): p for p in sorted(files)[::-1]}


def _exact(folder: Path, name: str) -> Path | None:
    """Return the mask in a folder of masks with exactly its photograph's name, or None."""
    path = folder / name
    names = (path, path.with_suffix(".png"), path.with_name(path.name + ".png"))
    return next((p for p in names if _holds_masks(folder) and p.is_file()), None)


def image_folder_of(view: View) -> Path:
    """Return the folder to which the name of a view is relative."""
    return view.image_path.parents[len(Path(view.name).parts) - 1]


def background_color(cfg: DataConfig) -> Float32[np.ndarray, " 3"]:
    """Return the background of photographs with alpha in pictures and scores, display values.

    Raises UserError: the option is not a colour.
    """
    text = SCORE_BACKGROUND if cfg.background == RANDOM else cfg.background
    if text in NAMED_COLORS:
        return np.array(NAMED_COLORS[text], np.float32)
    try:
        color = np.array([float(word) for word in text.split(",")], np.float32)
    except ValueError:
        color = np.zeros(0, np.float32)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        fix = "use white, black, random, or display values from 0 to 1: --background 0.5,0.5,0.5"
        raise UserError(f"--background {cfg.background} is not a valid colour.", fix=fix)
    return color


def has_alpha(path: Path) -> bool:
    """Return whether an image file has an alpha channel; False for a broken file."""
    if path.suffix.lower() in _OPAQUE:
        return False
    try:
        with Image.open(path) as image:
            return image.mode in ("RGBA", "LA", "La", "PA") or "transparency" in image.info
    except Exception:  # PIL's error types are not a closed set; decoding reports the error
        return False


def _opacity(paths: Sequence[Path]) -> tuple[int, int]:
    """Return the least and the most alpha of photographs, 0 to 255.

    Reading stops once transparent and other pixels are found. Unreadable photographs are skipped.
    """
    least, most = 255, 0
    for path in paths:
        with contextlib.suppress(Exception), Image.open(path) as image:
            alpha = np.asarray(image.convert("RGBA").getchannel("A"))
            least, most = min(least, int(alpha.min())), max(most, int(alpha.max()))
        if least < 255 and most > 0:
            break
    return least, max(least, most)


def with_alpha(scene: Scene, cfg: DataConfig) -> Scene:
    """Return a scene whose views state the use of their alpha channels, unless all are opaque.

    Raises UserError: the option is not a colour, or all photographs are transparent everywhere.
    """
    background_color(cfg)
    found = [has_alpha(view.image_path) for view in scene.views]
    channels = [view.image_path for view, has in zip(scene.views, found, strict=True) if has]
    least, most = _opacity(channels)
    if most == 0 and all(found) and cfg.alpha != "ignore":
        why = "is transparent everywhere, as are all photographs of the scene"
        fix = "export them again without an alpha channel, or add --data.alpha ignore"
        raise broken(channels[0], why, fix)
    # Some programs write alpha channels that are opaque everywhere.
    if least == 255:
        if cfg.background == DataConfig.background:
            return scene
        note = f"--background {cfg.background} has no effect: no photograph has transparent pixels."
        return dataclasses.replace(scene, notes=(*scene.notes, note))
    views = tuple(
        dataclasses.replace(view, alpha=cfg.alpha) if has else view
        for view, has in zip(scene.views, found, strict=True)
    )
    over = "a random colour at every step, and over white for scores"
    over = over if cfg.background == RANDOM else cfg.background
    use = {
        "background": f"photographs and renders are shown over {over} (--background)",
        "mask": "transparent pixels are left out (--data.alpha mask)",
        "ignore": "it is ignored (--data.alpha ignore)",
    }[cfg.alpha]
    note = f"{sum(found)} of {len(found)} photographs have an alpha channel: {use}."
    if cfg.alpha != "background" and cfg.background != DataConfig.background:
        note += f" --background {cfg.background} has no effect."
    return dataclasses.replace(scene, views=views, notes=(*scene.notes, note))
