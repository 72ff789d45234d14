"""The data of a page besides its Gaussians: views with their photometry, curves, and a look."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.formats.false_color import false_color
from p2gs_jax.formats.frames import data_url, shrunk
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.photometry.response import by_camera, tables
from p2gs_jax.run.read import Run
from p2gs_jax.scene.rigid import up_direction

# Middles of the steps of false colour, stops from mid-grey (formats/false_color.py).
STEPS = np.arange(-6, 6) + 0.5
# Longer side of embedded photographs, pixels, and their WebP quality, percent.
LONGEST, QUALITY = 960, 80
# Significant digits of numbers in the page, enough for float32.
DIGITS = 7


def page_scene(
    fitted: Run, look: DisplayTransform, photographs: Mapping[int, str]
) -> dict[str, Any]:
    """Return the data of the page besides the Gaussians, as plain values or arrays.

    The page opens with `look`; `photographs` has data URLs by row in `scene.views`.
    """
    mean, cfg = fitted.mean.exposure_geometric, fitted.cfg.render
    return {
        "render": {
            "radiance": cfg.radiance,
            "near": cfg.near,
            "blur": cfg.blur,
            "alphaMax": cfg.alpha_max,
            "logCutoff": float(np.log(cfg.alpha_cutoff)),
        },
        "look": {
            "exposure": mean,
            "ev": float(np.log2(look.exposure / mean)),
            "gamma": look.gamma,
            "balance": _balance(look),
            "curve": look.formation.curve,
        },
        "tone": _tone(fitted),
        "views": [_view(fitted, index, mean) for index in range(len(fitted.scene.views))],
        "start": _start(fitted),
        "up": up_direction(np.stack([view.viewmat for view in fitted.scene.views])).tolist(),
        "stopColors": false_color(np.exp2(STEPS)[None, :, None] * np.ones(3), 1.0)[0],
        "photographs": {str(index): url for index, url in photographs.items()},
    }


def embedded_photographs(fitted: Run, count: int) -> dict[int, str]:
    """Return at most `count` evenly spaced, undistorted photographs as data URLs by row.

    Raises UserError: a photograph is missing or broken.
    """
    rows = [int(i) for i in evenly_spaced(len(fitted.scene.views), count)] if count else []
    fitted.require_photographs(rows)
    pictures = ((row, shrunk(fitted.photograph(row), LONGEST)) for row in rows)
    return {row: data_url("webp", picture, QUALITY) for row, picture in pictures}


def _tone(fitted: Run) -> dict[str, Any]:
    cfg = fitted.cfg.photometry
    curves, vignettings = None, [camera.vignetting for camera in cfg.cameras]
    if cfg.curve == "spline" and (cfg.spline is not None or by_camera(cfg)):
        found = tables(cfg)
        curves = {name: getattr(found, name) for name in ("first", "step", "values", "channels")}
        curves["values"] = found.values.astype(np.float32)
    return {"pivot": cfg.pivot, "tables": curves, "cameras": vignettings}


def _view(fitted: Run, index: int, mean: float) -> dict[str, Any]:
    camera, display = fitted.camera(index), fitted.own_display(index)
    view, K = fitted.scene.views[index], np.asarray(camera.K)
    return {
        "name": view.name,
        "camera": view.camera,
        "split": view.split,
        "ev": float(np.log2(display.exposure / mean)),
        "gamma": display.gamma,
        "balance": _balance(display),
        "row": -1 if display.camera is None else display.camera,
        "width": camera.width,
        "height": camera.height,
        "K": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        "viewmat": np.asarray(camera.viewmat)[:3].reshape(-1),
    }


def _balance(transform: DisplayTransform) -> list[float]:
    """Return the natural logarithms of the white balance factors."""
    return list(transform.white_balance or (0.0, 0.0, 0.0))


def _start(fitted: Run) -> int:
    """Return the row of the view shown first: the middle training view of the first camera."""
    views, train = fitted.scene.views, fitted.scene.train_indices
    rows = [row for row in train if views[row].camera == views[train[0]].camera]
    return rows[len(rows) // 2]


def rounded(value: Any) -> Any:
    """Return plain values with floats rounded to `DIGITS`; whole ones below 1e6 become integers."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, float):
        short = float(f"{value:.{DIGITS}g}")
        return int(short) if short.is_integer() and abs(short) < 1e6 else short
    return value
