"""Learned corrections: `appearance.npy`, `ppisp.json` or `luminance.json` (docs/files.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.config import Appearance
from p2gs_jax.core.atomic import write_array, write_json
from p2gs_jax.core.json_text import parse_json
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.appearance import Corrections, identity
from p2gs_jax.photometry.luminance import Luminance
from p2gs_jax.photometry.ppisp import Ppisp
from p2gs_jax.types import View


def write_appearance(path: Path, appearance: Corrections, views: Sequence[View]) -> None:
    """Write what was learned of all training views; exposures lie in `photometry.json`.

    Args:
        path: of the file.
        appearance: a row for each view, or the parameters of PPISP or Luminance-GS.
        views: the training views.
    """
    if isinstance(appearance, Ppisp):
        write_json(path, _ppisp_values(appearance, views))
    elif isinstance(appearance, Luminance):
        write_json(path, _luminance_values(appearance, views))
    else:
        write_array(path, np.asarray(appearance))


def read_appearance(path: Path, kind: Appearance, views: Sequence[View]) -> Corrections:
    """Return what `write_appearance` wrote.

    Args:
        path: of the file.
        kind: which correction.
        views: the training views.

    Raises:
        UserError: it cannot be read, or belongs to other views.
    """
    like = identity(kind, [view.camera for view in views])
    try:
        if isinstance(like, Ppisp):
            return _read_ppisp(parse_json(path.read_text(encoding="utf-8")), like, views)
        if isinstance(like, Luminance):
            return _read_luminance(parse_json(path.read_text(encoding="utf-8")), like, views)
        corrections = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path} cannot be read: {error}.", fix="finish the fit again with --resume"
        ) from error
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} does not belong to this run.", fix="fit again") from error
    if corrections.shape != like.shape:
        raise UserError(f"{path} does not belong to this run.", fix="fit again")
    return on_device(corrections)


def _ppisp_values(p: Ppisp, views: Sequence[View]) -> dict[str, Any]:
    return {
        "cameras": {
            name: {"response": response, "vignetting": vignetting}
            for name, response, vignetting in zip(
                p.names, np.asarray(p.responses), np.asarray(p.vignettings), strict=True
            )
        },
        "views": {
            view.name: {"camera": view.camera, "color": color}
            for view, color in zip(views, np.asarray(p.colors), strict=True)
        },
    }


def _read_ppisp(saved: dict[str, Any], like: Ppisp, views: Sequence[View]) -> Ppisp:
    """Return the parameters in the order of the views and of their cameras.

    Raises:
        KeyError: a view or a camera is missing.
    """
    of_views = [saved["views"][view.name] for view in views]
    of_cameras = [saved["cameras"][name] for name in like.names]

    def stacked(rows, key: str, shape: tuple[int, ...]):
        return on_device(np.array([row[key] for row in rows], np.float32).reshape(shape))

    return Ppisp(
        like.exposures,
        stacked(of_views, "color", like.colors.shape),
        stacked(of_cameras, "response", like.responses.shape),
        stacked(of_cameras, "vignetting", like.vignettings.shape),
        like.names,
        like.cameras,
    )


# Parameters of all views, and those of single ones, as they are called in the file.
_SHARED = ("curve", "hidden", "hidden_bias", "out", "out_bias")
_OF_VIEWS = ("axes", "statistics")


def _luminance_values(p: Luminance, views: Sequence[View]) -> dict[str, Any]:
    return {
        **{name: np.asarray(getattr(p, name)) for name in _SHARED},
        "views": {
            view.name: {name: np.asarray(getattr(p, name)[k]) for name in _OF_VIEWS}
            for k, view in enumerate(views)
        },
    }


def _read_luminance(saved: dict[str, Any], like: Luminance, views: Sequence[View]) -> Luminance:
    """Return the parameters in the order of the views.

    Raises:
        KeyError: a view or a parameter is missing.
        ValueError: a parameter has another shape.
    """
    of_views = [saved["views"][view.name] for view in views]
    values = {name: saved[name] for name in _SHARED}
    values |= {name: [row[name] for row in of_views] for name in _OF_VIEWS}

    def shaped(name: str):
        return on_device(np.array(values[name], np.float32).reshape(getattr(like, name).shape))

    return Luminance(**{name: shaped(name) for name in values})
