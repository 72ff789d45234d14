"""Gaussians as PLY in the field order of the reference implementation (Inria).

`splats.ply` carries display colours, so common viewers show it as it should look; `radiance.ply`
carries the linear pre-activation coefficients, untouched.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from plyfile import PlyData, PlyElement, PlyParseError

from p2gs_jax.errors import UserError
from p2gs_jax.export.atomic import atomic_write
from p2gs_jax.photometry.radiance import RadianceKind, radiance_activation
from p2gs_jax.render.spherical_harmonics import basis, degree_of
from p2gs_jax.types import Gaussians

DIRECTIONS = 64
CHUNK = 65536


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


def _live(gaussians: Gaussians, alive: Bool[np.ndarray, " n"]) -> Gaussians:
    rows = np.flatnonzero(np.asarray(alive))
    return jax.tree.map(lambda a: a[rows], gaussians)


def _write(path: Path, g: Gaussians, comments: list[str]) -> int:
    count, coefficients = g.sh.shape[:2]
    # All coefficients of red, then green, then blue.
    rest = np.asarray(g.sh[:, 1:]).transpose(0, 2, 1).reshape(count, 3 * (coefficients - 1))
    columns = np.concatenate(
        [
            g.means,
            np.zeros((count, 3), np.float32),
            g.sh[:, 0],
            rest,
            np.asarray(g.opacity_logits)[:, None],
            g.log_scales,
            g.quats,
        ],
        axis=1,
    ).astype("<f4")
    names = field_names(coefficients)
    table = np.ascontiguousarray(columns).view([(n, "<f4") for n in names]).reshape(count)
    data = PlyData([PlyElement.describe(table, "vertex")], byte_order="<", comments=comments)
    with atomic_write(path) as temporary:
        data.write(str(temporary))
    return count


def display_sh(
    sh: Float[np.ndarray, "n k 3"],
    tone: Callable[[np.ndarray], np.ndarray],
    activation: RadianceKind,
) -> Float[np.ndarray, "n k 3"]:
    """Return coefficients whose value + 1/2 is the display colour, least squares over directions.

    Exact for degree 0. The tone curve of a mixture is not the mixture of tone curves, so a
    composited image still differs from the true render; the linear file does not.
    """
    directions = _sphere(DIRECTIONS)
    degree = degree_of(sh.shape[1])
    table = np.stack([np.asarray(b) for b in basis(tuple(jnp.asarray(directions).T), degree)], 1)
    inverse = np.linalg.pinv(table)
    out = np.empty_like(sh)
    for start in range(0, len(sh), CHUNK):
        part = sh[start : start + CHUNK]
        values = np.einsum("dk,nkc->ndc", table, part, optimize=True).astype(np.float32)
        colors = tone(np.asarray(radiance_activation(jnp.asarray(values), activation)))
        shown = np.clip(colors, 0, 1) - 0.5
        out[start : start + CHUNK] = np.einsum("kd,ndc->nkc", inverse, shown, optimize=True)
    return out


def _sphere(count: int) -> Float[np.ndarray, "n 3"]:
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    azimuth = np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], -1).astype(np.float32)


def write_splats(
    path: Path,
    gaussians: Gaussians,
    alive: Bool[np.ndarray, " n"],
    *,
    tone: Callable[[np.ndarray], np.ndarray],
    activation: RadianceKind,
    exposure: float = 1.0,
    gamma: float | None = None,
) -> int:
    """Write live Gaussians with display colours; return how many.

    Args:
        path: the file.
        gaussians: linear radiance.
        alive: which to write.
        tone: exposed radiance -> display values, clamped to [0, 1] here.
        activation: of the spherical harmonics.
        exposure: multiplies the radiance before `tone`; leave it at 1 where `tone` exposes.
        gamma: what `tone` uses, recorded in a comment.
    """
    g = _live(gaussians, alive)
    sh = display_sh(np.asarray(g.sh), lambda linear: tone(exposure * linear), activation)
    shown = dataclasses.replace(g, sh=jnp.asarray(sh))
    comments = ["p2gs-jax: display colours, tone-mapped"]
    if exposure != 1.0:
        comments.append(f"p2gs-jax: exposure {exposure:.6g}")
    if gamma is not None:
        comments.append(f"p2gs-jax: gamma {gamma:.6g}")
    return _write(path, shown, comments)


def write_radiance(
    path: Path, gaussians: Gaussians, alive: Bool[np.ndarray, " n"], *, activation: RadianceKind
) -> int:
    """Write live Gaussians with their linear coefficients; return how many."""
    return _write(
        path,
        _live(gaussians, alive),
        ["p2gs-jax: linear HDR radiance", f"p2gs-jax: radiance activation {activation}"],
    )


def read_ply(path: Path) -> Gaussians:
    """Read Gaussians back, bit for bit.

    Raises:
        UserError: the file is no such PLY.
    """
    try:
        vertex = PlyData.read(str(path))["vertex"].data
        names = vertex.dtype.names or ()
        coefficients = 1 + sum(n.startswith("f_rest_") for n in names) // 3
        columns = np.stack([vertex[n] for n in field_names(coefficients)], 1).astype(np.float32)
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise UserError(
            f"{path} is no PLY of Gaussians: {error}.",
            fix="restore it from a copy, or write it again with `p2gs-jax fit ... --resume`",
        ) from error
    rest = columns[:, 9 : 9 + 3 * (coefficients - 1)].reshape(len(columns), 3, coefficients - 1)
    sh = np.concatenate([columns[:, None, 6:9], rest.transpose(0, 2, 1)], 1)
    tail = columns[:, 9 + 3 * (coefficients - 1) :]
    return Gaussians(
        means=jnp.asarray(columns[:, :3]),
        quats=jnp.asarray(tail[:, 4:8]),
        log_scales=jnp.asarray(tail[:, 1:4]),
        opacity_logits=jnp.asarray(tail[:, 0]),
        sh=jnp.asarray(sh),
    )
