"""Which pixels of photographs count: masks that lie beside them, and their alpha channels."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from PIL import Image

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.types import Scene, View

RANDOM = "random"
NAMED = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
# Where training draws a colour for every step, photographs are judged over what 3DGS shows.
JUDGED = "white"
# These never have an alpha channel.
_OPAQUE = frozenset({".jpg", ".jpeg", ".ppm"})


def attach_masks(views: tuple[View, ...]) -> tuple[tuple[View, ...], list[str]]:
    """Return views with masks in `masks/` beside the image folder or in it, and a note."""
    masked = tuple(
        view if view.mask_path else dataclasses.replace(view, mask_path=mask_of(view))
        for view in views
    )
    bare = [view.name for view in masked if view.mask_path is None]
    if not bare or len(bare) == len(masked):
        return masked, []
    return masked, [f"{len(bare)} of {len(masked)} views have no mask: {first_few(bare)}"]


def first_few(names: Sequence[str]) -> str:
    """Return the first of some names for a message."""
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def mask_of(view: View) -> Path | None:
    """Return the mask of a photograph where it lies in the folder of the images, or None."""
    image_folder = image_folder_of(view)
    for folder in (image_folder.parent / "masks", image_folder / "masks"):
        path = folder / view.name
        for p in (path, path.with_suffix(".png"), path.with_name(path.name + ".png")):
            if p.is_file():
                return p
    return None


def image_folder_of(view: View) -> Path:
    """Return the folder that the name of a view is relative to."""
    return view.image_path.parents[len(Path(view.name).parts) - 1]


def background_color(cfg: DataConfig) -> Float32[np.ndarray, " 3"]:
    """Return the display values that photographs with alpha are shown and judged over.

    Raises UserError: the option is not a colour.
    """
    text = JUDGED if cfg.background == RANDOM else cfg.background
    if text in NAMED:
        return np.array(NAMED[text], np.float32)
    try:
        color = np.array([float(word) for word in text.split(",")], np.float32)
    except ValueError:
        color = np.zeros(0, np.float32)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        fix = "use white, black, random, or display values from 0 to 1: --background 0.5,0.5,0.5"
        raise UserError(f"--background {cfg.background} is not a valid colour", fix=fix)
    return color


def has_alpha(path: Path) -> bool:
    """Return whether an image file carries an alpha channel; a broken file has none."""
    if path.suffix.lower() in _OPAQUE:
        return False
    try:
        with Image.open(path) as image:
            return image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
    except Exception:  # PIL's error types are not a closed set; decoding will complain
        return False


def with_alpha(scene: Scene, cfg: DataConfig) -> Scene:
    """Return a scene whose views know what their alpha channel means.

    Raises UserError: the option is not a colour.
    """
    background_color(cfg)
    found = [has_alpha(view.image_path) for view in scene.views]
    if not any(found):
        if cfg.background == DataConfig.background:
            return scene
        note = f"--background {cfg.background} shows nowhere: no photograph has an alpha channel."
        return dataclasses.replace(scene, notes=(*scene.notes, note))
    views = tuple(
        dataclasses.replace(view, alpha=cfg.alpha) if there else view
        for view, there in zip(scene.views, found, strict=True)
    )
    over = "a random colour at every step, and white to judge"
    over = over if cfg.background == RANDOM else cfg.background
    use = {
        "background": f"photographs and renders are shown over {over} (--background)",
        "mask": "transparent pixels are left out (--data.alpha mask)",
        "ignore": "it is ignored (--data.alpha ignore)",
    }[cfg.alpha]
    note = f"{sum(found)} of {len(found)} photographs have an alpha channel: {use}."
    return dataclasses.replace(scene, views=views, notes=(*scene.notes, note))
