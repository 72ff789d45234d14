"""Binary glTF with KHR_gaussian_splatting (Khronos): a point primitive whose attributes are splats.

Attributes follow the extension: scales are lengths, opacities are in [0, 1], rotations are x y z w,
harmonics are as in 3DGS. glTF's world has y up, so COLMAP's axes are turned by 180 degrees about x.
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from scipy.special import expit

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.formats.ply import unit_quats
from p2gs_jax.gaussians.posed import half_turn
from p2gs_jax.render.harmonics import degree_of
from p2gs_jax.types import Gaussians

EXTENSION = "KHR_gaussian_splatting"
FLOAT, POINTS, ARRAY_BUFFER = 5126, 0, 34962  # glTF's codes
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # by number of components
MAGIC, VERSION, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942  # of GLB


def write_gltf(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians with display colours and COLMAP's axes as `.glb`.

    Raises UserError: there are no Gaussians, because glTF forbids an empty accessor.
    """
    if gaussians.capacity == 0:
        fix = "choose another format"
        raise UserError("glTF cannot hold a scene without static Gaussians.", fix=fix)
    columns = _attributes(half_turn(gaussians))
    data = [np.ascontiguousarray(c, "<f4").tobytes() for c in columns.values()]
    starts = np.cumsum([0, *map(len, data)]).tolist()
    splats = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "mode": POINTS,
        "attributes": {name: k for k, name in enumerate(columns)},
        "extensions": {EXTENSION: splats},
    }
    document = {
        "asset": {"version": "2.0", "generator": "p2gs-jax"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "splats"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [_accessor(k, name, c) for k, (name, c) in enumerate(columns.items())],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(d), "target": ARRAY_BUFFER}
            for start, d in zip(starts[:-1], data, strict=True)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + starts[-1]
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<III", MAGIC, VERSION, size))
        file.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
        file.write(struct.pack("<II", starts[-1], BINARY_CHUNK) + b"".join(data))


def _attributes(g: Gaussians) -> dict[str, Float32[np.ndarray, "n _"]]:
    sh = np.asarray(g.sh)
    columns = {
        "POSITION": np.asarray(g.means),
        f"{EXTENSION}:ROTATION": np.roll(unit_quats(g), -1, axis=1),
        f"{EXTENSION}:SCALE": np.exp(np.asarray(g.log_scales)),
        f"{EXTENSION}:OPACITY": expit(np.asarray(g.opacity_logits))[:, None],
    }
    for degree in range(degree_of(sh.shape[1]) + 1):
        for order in range(2 * degree + 1):
            name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"
            columns[name] = sh[:, degree**2 + order]
    return {name: np.asarray(c, np.float32) for name, c in columns.items()}


def _accessor(view: int, name: str, column: Float32[np.ndarray, "n k"]) -> dict[str, Any]:
    out: dict[str, Any] = {
        "bufferView": view,
        "componentType": FLOAT,
        "count": len(column),
        "type": KINDS[column.shape[1]],
    }
    if name == "POSITION":
        out |= {"min": column.min(0).tolist(), "max": column.max(0).tolist()}
    return out
