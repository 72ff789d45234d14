"""Gaussians as PLY in the field order of the reference implementation (Inria).

Files hold display colours (gaussians/bake.py), which common viewers show correctly, or the linear
coefficients before the activation of radiance (`radiance.ply`, `linear.ply`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.ply import header_of, read_table, refusing
from p2gs_jax.render.harmonics import RadianceKind
from p2gs_jax.types import Gaussians, Vibration


def field_names(coefficients: int) -> list[str]:
    """Return the PLY properties in order, for (degree + 1)^2 coefficients."""
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * (coefficients - 1))),
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]


# The comment of files with radiance instead of display colours.
LINEAR = "p2gs-jax: linear HDR radiance"
# Fields of vibrating Gaussians, after the fields of the reference implementation.
VIBRATION = ("velocity_x", "velocity_y", "velocity_z", "peak_time", "log_life")
# Rows that are written or read at a time, about 16 MB; a whole file may have some gigabytes.
CHUNK = 65536


def unit_quats(gaussians: Gaussians) -> Float[np.ndarray, "n 4"]:
    """Return unit quaternions wxyz in float64; zero quaternions stay zero."""
    quats = np.asarray(gaussians.quats, np.float64)
    return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)


def write_ply(path: Path, gaussians: Gaussians, comments: Sequence[str]) -> None:
    """Write Gaussians without conversion.

    `comments` become lines of the header, with all characters except ASCII escaped.
    """
    g = jax.tree.map(np.asarray, gaussians)
    names = [*field_names(g.sh.shape[1]), *(() if g.vibration is None else VIBRATION)]
    row = np.dtype([(name, "<f4") for name in names])
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(header_of(row, g.capacity, comments))
        for first in range(0, g.capacity, CHUNK):
            file.write(_columns(g, slice(first, first + CHUNK)).tobytes())


def _columns(g: Gaussians, rows: slice) -> Float[np.ndarray, "k c"]:
    sh = g.sh[rows]
    count = len(sh)
    vibration = []
    if g.vibration is not None:
        v = g.vibration
        vibration = [v.velocities[rows], v.peaks[rows][:, None], v.log_lives[rows][:, None]]
    columns = [
        g.means[rows],
        np.zeros((count, 3), np.float32),
        sh[:, 0],
        # The file has all coefficients of red, then green, then blue.
        sh[:, 1:].transpose(0, 2, 1).reshape(count, -1),
        g.opacity_logits[rows][:, None],
        g.log_scales[rows],
        g.quats[rows],
        *vibration,
    ]
    return np.concatenate(columns, axis=1).astype("<f4")


def write_radiance(path: Path, gaussians: Gaussians, *, activation: RadianceKind) -> None:
    """Write Gaussians with their linear coefficients."""
    write_ply(path, gaussians, [LINEAR, f"p2gs-jax: radiance activation {activation}"])


RESTORE = "restore it from a copy, or write it again with `p2gs-jax fit ... --resume`"


def read_ply(path: Path, fix: str = RESTORE) -> Gaussians:
    """Read Gaussians, bit for bit. Normals, which are not used, may be missing.

    Raises UserError: the file is not such a PLY; `fix` is the remedy.
    """
    with refusing(path, "Gaussians", fix=fix):
        return _read(read_table(path, "vertex"))


def _read(vertex: np.ndarray) -> Gaussians:
    """Return the Gaussians of a table; each row is read once, `CHUNK` rows at a time."""
    names = vertex.dtype.names or ()
    bands = sum(n.startswith("f_rest_") for n in names) // 3
    harmonics = [[f"f_dc_{c}" for c in range(3)]]
    harmonics += [[f"f_rest_{c * bands + k}" for c in range(3)] for k in range(bands)]
    wanted: list[Any] = [
        ["x", "y", "z"],
        [f"rot_{i}" for i in range(4)],
        [f"scale_{i}" for i in range(3)],
        "opacity",
        harmonics,
    ]
    if VIBRATION[0] in names:
        wanted += [list(VIBRATION[:3]), *VIBRATION[3:]]
    fields = [np.array(part) for part in wanted]
    arrays = [np.empty((len(vertex), *part.shape), np.float32) for part in fields]
    for first in range(0, len(vertex), CHUNK):
        rows = slice(first, first + CHUNK)
        for part, array in zip(fields, arrays, strict=True):
            for place, name in np.ndenumerate(part):
                array[(rows, *place)] = vertex[rows][str(name)]
    # Each array is released once the device has a copy.
    found = [on_device(arrays.pop(0)) for _ in range(len(arrays))]
    return Gaussians(*found[:5], vibration=Vibration(*found[5:]) if found[5:] else None)
