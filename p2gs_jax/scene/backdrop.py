"""Backgrounds of photographs with an alpha channel, and which photographs have one."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from PIL import Image

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.types import Scene

RANDOM = "random"
NAMED = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
# Over this where training draws a colour for every step: what 3DGS shows.
JUDGED = "white"
# These never have one.
_OPAQUE = frozenset({".jpg", ".jpeg", ".ppm"})


def backdrop_of(cfg: DataConfig) -> Float32[np.ndarray, " 3"]:
    """Return the display values that photographs are shown and judged over.

    Raises:
        UserError: the option names no colour.
    """
    text = JUDGED if cfg.background == RANDOM else cfg.background
    if text in NAMED:
        return np.array(NAMED[text], np.float32)
    try:
        color = np.array([float(word) for word in text.split(",")], np.float32)
    except ValueError:
        color = np.zeros(0, np.float32)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        raise UserError(
            f"--background {cfg.background} is no colour",
            fix="use white, black, random, or display values from 0 to 1: --background 0.5,0.5,0.5",
        )
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

    Raises:
        UserError: the option names no colour.
    """
    backdrop_of(cfg)
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
    what = {
        "background": f"photographs and renders are shown over {over} (--background)",
        "mask": "transparent pixels are left out (--data.alpha mask)",
        "ignore": "it is not looked at (--data.alpha ignore)",
    }[cfg.alpha]
    note = f"{sum(found)} of {len(found)} photographs have an alpha channel: {what}."
    return dataclasses.replace(scene, views=views, notes=(*scene.notes, note))
