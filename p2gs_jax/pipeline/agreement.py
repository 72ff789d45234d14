"""What all processes of a fit must have in common."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.config import to_dict as config_to_dict
from p2gs_jax.core.devices import Devices
from p2gs_jax.core.processes import require_same
from p2gs_jax.pipeline.prepare import Prepared


def agree_on_options(cfg: FitConfig, devices: Devices | None, resume: bool) -> None:
    """Refuse processes with different options; those of the evaluation are of the first alone.

    Raises:
        UserError: the first options that differ are named, with both values.
    """
    mine = _flat({k: v for k, v in config_to_dict(cfg).items() if k != "evaluation"})
    chosen = devices or Devices()
    require_same(
        "options", mine | {"resume": resume, "devices": chosen.count, "shard": chosen.shard}
    )


def same_start(prepared: Prepared) -> Prepared:
    """Return what the first process prepared, where the scenes are the same.

    Sums may come out otherwise on another kind of processor: the start is sent, not compared.

    Args:
        prepared: by this process.

    Raises:
        UserError: the scenes differ, or what was decided from them.
    """
    if jax.process_count() == 1:
        return prepared
    from jax.experimental import multihost_utils

    scene = prepared.scene
    views = [(v.name, v.split, v.camera, v.width, v.height) for v in scene.views]
    mine = {
        "views": len(scene.views),
        "names, split and sizes of the views": _digest(repr(views).encode()),
        "cameras": _digest(*(a for v in scene.views for a in (v.viewmat, v.K))),
        "points": len(scene.points),
        "places of the points": _digest(scene.points),
        "Gaussians to start from": prepared.params.gaussians.capacity,
    }
    require_same("scene", mine)
    require_same("decisions", _flat(prepared.decisions.to_dict()))
    params = multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, prepared.params))
    return dataclasses.replace(prepared, params=params)


def _digest(*parts: Any) -> str:
    found = hashlib.sha256()
    for part in parts:
        found.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return found.hexdigest()[:16]


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested values by dotted names, as text."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = str(value)
    return found
