"""Masks that lie beside photographs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from p2gs_jax.types import View


def attach_masks(views: tuple[View, ...]) -> tuple[tuple[View, ...], list[str]]:
    """Find masks in `masks/` beside the image folder or in it, where a reader named none.

    Returns:
        The views with them, and what to say of those that have none.
    """
    masked = tuple(
        view if view.mask_path else dataclasses.replace(view, mask_path=mask_of(view))
        for view in views
    )
    without = [view.name for view in masked if view.mask_path is None]
    if not without or len(without) == len(masked):
        return masked, []
    listed = ", ".join(without[:5]) + (", ..." if len(without) > 5 else "")
    return masked, [f"{len(without)} of {len(masked)} views have no mask: {listed}"]


def mask_of(view: View) -> Path | None:
    """Return the mask of a photograph where it lies in the folder of the images, or None."""
    image_folder = view.image_path
    for _ in Path(view.name).parts:
        image_folder = image_folder.parent
    for folder in (image_folder.parent / "masks", image_folder / "masks"):
        path = folder / view.name
        for p in (path, path.with_suffix(".png"), path.with_name(path.name + ".png")):
            if p.is_file():
                return p
    return None
