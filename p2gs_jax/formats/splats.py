"""Splats of other programs: Gaussians with display colours, from the files that trainers write."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from scipy.special import logit

from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError, broken
from p2gs_jax.formats import gsply_files
from p2gs_jax.formats.ply import LINEAR, read_ply
from p2gs_jax.render.harmonics import degree_of
from p2gs_jax.types import Gaussians

AGAIN = "write it again with the program that trained it, or name another file"
SOG_VERSION = 2
SOG_PARTS = ("scales", "sh0", "shN")  # the parts of `meta.json` with tables
# The number of palette entries in a row of SOG's texture.
PALETTE_ROW = 64
# The alpha of SOG's rotations is this plus the index of the omitted component in w, x, y, z.
FIRST_OMITTED = 252
# SOG's opacities of 8 bits are at least half a step from 0 and 1, so that logits are finite.
LEAST_OPACITY = 0.5 / 255


def read_splats(path: Path) -> Gaussians:
    """Read Gaussians in the axes of PLY.

    UserError: the file has another format or number of harmonics, holds radiance, or is broken.
    """
    read = next((READERS[end] for end in READERS if path.name.lower().endswith(end)), None)
    if read is None:
        fix = f"name a file of these formats: {', '.join(READERS)}"
        raise UserError(f"{path} is not a file of splats.", fix=fix)
    if not path.is_file():
        raise broken(path, "is not a file", "check the path of the splats")
    try:
        with path.open("rb") as file:
            if LINEAR.encode() in file.read(1024):
                raise ValueError("it holds the radiance of a run, not display colours")
        found = read(path)
        degree_of(found.sh.shape[1])
        return found
    except UserError:
        raise
    except Exception as error:  # a damaged file raises many kinds of errors
        why = (str(error) or type(error).__name__).strip("'\"").rstrip(".")
        raise UserError(f"{path} is not readable as splats: {why}.", fix=AGAIN) from error


def read_sog(path: Path) -> Gaussians:
    """Read SOG, the compressed splats of PlayCanvas and SuperSplat, version 2: a ZIP of textures.

    A texel belongs to one Gaussian, in rows from the top, except in the palette. Positions have 16
    bits on a logarithmic scale; rotations omit the largest component; log scales and colours are
    indices into tables of 256. Higher harmonics are entries of the palette.
    Source: developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.
    ValueError: the file has another version, or its parts disagree. A damaged file raises many
    kinds of errors.
    """
    with zipfile.ZipFile(path) as file:
        return _sog(file)


def _sog(file: zipfile.ZipFile) -> Gaussians:
    meta = parse_json(file.read("meta.json").decode())
    if meta.get("version") != SOG_VERSION:
        raise ValueError(
            f"its version is {meta.get('version')}, and this program reads {SOG_VERSION}"
        )

    def texture(part: str, number: int = 0) -> UInt8[np.ndarray, "h w 4"]:
        with Image.open(io.BytesIO(file.read(meta[part]["files"][number]))) as picture:
            return np.asarray(picture.convert("RGBA"))

    def texels(part: str, number: int = 0) -> UInt8[np.ndarray, "n 4"]:
        return texture(part, number).reshape(-1, 4)[: meta["count"]]

    tables = {part: np.array(meta[part].get("codebook", ())) for part in SOG_PARTS if part in meta}
    low, high = (np.array(meta["means"][end], float) for end in ("mins", "maxs"))
    whole = (texels("means", 0) + 256.0 * texels("means", 1))[:, :3]
    logs = low + whole / 65535 * (high - low)
    base = texels("sh0")
    sh = tables["sh0"][base[:, None, :3]]
    if "shN" in meta:
        size = (meta["shN"]["bands"] + 1) ** 2 - 1
        palette = texture("shN")[:, : PALETTE_ROW * size, :3].reshape(-1, size, 3)
        labels = texels("shN", 1)[:, :2] @ np.array([1, 256])
        sh = np.concatenate([sh, tables["shN"][palette[labels]]], axis=1)
    logits = logit(np.clip(base[:, 3] / 255, LEAST_OPACITY, 1 - LEAST_OPACITY))
    means, scales = np.sign(logs) * np.expm1(np.abs(logs)), texels("scales")[:, :3]
    parts = (means, _rotations(texels("quats")), tables["scales"][scales], logits, sh)
    if {len(part) for part in parts} != {meta["count"]}:
        raise ValueError("its textures have fewer texels than it has Gaussians")
    return Gaussians(*map(on_device, parts))


def _rotations(texels: UInt8[np.ndarray, "n 4"]) -> np.ndarray:
    """Return unit quaternions, wxyz, [n 4]."""
    omitted = texels[:, 3].astype(int) - FIRST_OMITTED
    three = (texels[:, :3] / 255 - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(1 - (three**2).sum(1, keepdims=True), 0))
    # For each omitted component: the indices of w, x, y, z in `largest` followed by `three`.
    places = np.argsort([[k, *(j for j in range(4) if j != k)] for k in range(4)], axis=1)
    return np.take_along_axis(np.concatenate([largest, three], 1), places[omitted], 1)


# Readers by the end of the name; `.compressed.ply` comes before `.ply`.
READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".compressed.ply": gsply_files.read_compressed_ply,
    ".ply": lambda path: read_ply(path, AGAIN),
    ".spz": gsply_files.read_spz,
    ".sog": read_sog,
}
