"""Gaussians as PLY in the field order of the reference implementation (Inria).

Common viewers show files with display colours (gaussians/bake.py) correctly; `radiance.ply` holds
the linear pre-activation coefficients, unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool, Float
from plyfile import PlyData, PlyElement, PlyParseError

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.render.radiance import RadianceKind
from p2gs_jax.scene.point_cloud import check_counts
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


# Behind the fields of the reference implementation, where Gaussians vibrate.
VIBRATION = ("velocity_x", "velocity_y", "velocity_z", "peak_time", "log_life")


def _live(gaussians: Gaussians, alive: Bool[np.ndarray, " n"]) -> Gaussians:
    rows = np.flatnonzero(np.asarray(alive))
    return jax.tree.map(lambda a: np.asarray(a)[rows], gaussians)


def write_ply(path: Path, gaussians: Gaussians, comments: Sequence[str]) -> int:
    """Write all Gaussians as they are; return how many.

    Args:
        path: the file.
        gaussians: what to write.
        comments: header lines; a PLY header is ASCII, other characters are escaped.
    """
    g = jax.tree.map(np.asarray, gaussians)
    count, coefficients = g.sh.shape[:2]
    # All coefficients of red, then green, then blue.
    rest = g.sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (coefficients - 1))
    moves = [] if g.vibration is None else [_columns_of(g.vibration)]
    columns = np.concatenate(
        [
            g.means,
            np.zeros((count, 3), np.float32),
            g.sh[:, 0],
            rest,
            g.opacity_logits[:, None],
            g.log_scales,
            g.quats,
            *moves,
        ],
        axis=1,
    ).astype("<f4")
    names = [*field_names(coefficients), *(VIBRATION if moves else ())]
    table = np.ascontiguousarray(columns).view([(n, "<f4") for n in names]).reshape(count)
    lines = [c.encode("unicode_escape").decode() for c in comments]
    data = PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=lines)
    with atomic_write(path) as temporary:
        data.write(str(temporary))
    return count


def write_radiance(
    path: Path, gaussians: Gaussians, alive: Bool[np.ndarray, " n"], *, activation: RadianceKind
) -> int:
    """Write live Gaussians with their linear coefficients; return how many."""
    return write_ply(
        path,
        _live(gaussians, alive),
        ["p2gs-jax: linear HDR radiance", f"p2gs-jax: radiance activation {activation}"],
    )


RESTORE = "restore it from a copy, or write it again with `p2gs-jax fit ... --resume`"


def read_ply(path: Path, *, fix: str = RESTORE) -> Gaussians:
    """Read Gaussians back, bit for bit. Normals, which mean nothing, may be missing.

    Args:
        path: the file.
        fix: what to do about a file that is none.

    Raises:
        UserError: the file is no such PLY.
    """
    if path.is_file():
        check_counts(path, fix=fix)
    try:
        vertex = PlyData.read(str(path))["vertex"].data
        names = vertex.dtype.names or ()

        def columns(*wanted: str) -> np.ndarray:
            return np.stack([np.asarray(vertex[n], np.float32) for n in wanted], 1)

        bands = sum(n.startswith("f_rest_") for n in names) // 3
        base = columns(*(f"f_dc_{i}" for i in range(3)))[:, None]
        rest = columns(*(f"f_rest_{i}" for i in range(3 * bands))) if bands else base[:, :, :0]
        rest = rest.reshape(len(base), 3, bands).transpose(0, 2, 1)
        moves = None
        if VIBRATION[0] in names:
            found = [np.asarray(vertex[n], np.float32) for n in VIBRATION]
            velocities = np.stack(found[:3], 1)
            moves = Vibration(*(on_device(a) for a in (velocities, *found[3:])))
        return Gaussians(
            means=on_device(columns("x", "y", "z")),
            quats=on_device(columns(*(f"rot_{i}" for i in range(4)))),
            log_scales=on_device(columns(*(f"scale_{i}" for i in range(3)))),
            opacity_logits=on_device(np.asarray(vertex["opacity"], np.float32)),
            sh=on_device(np.concatenate([base, rest], 1)),
            vibration=moves,
        )
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise UserError(f"{path} is no PLY of Gaussians: {error}.", fix=fix) from error


def _columns_of(moves: Vibration) -> Float[np.ndarray, "n 5"]:
    parts = moves.velocities, moves.peaks[:, None], moves.log_lives[:, None]
    return np.concatenate([np.asarray(part) for part in parts], axis=1)
