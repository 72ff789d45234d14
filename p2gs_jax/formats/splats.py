"""Splats of other programs: Gaussians with display colours, from the files that trainers write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from p2gs_jax.errors import UserError, broken
from p2gs_jax.formats import gsply_files
from p2gs_jax.formats.ply import LINEAR, read_ply
from p2gs_jax.formats.sog import read_sog
from p2gs_jax.render.harmonics import degree_of
from p2gs_jax.types import Gaussians

AGAIN = "write it again with the program that trained it, or name another file"
# Readers by the end of the name; `.compressed.ply` comes before `.ply`.
READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".compressed.ply": gsply_files.read_compressed_ply,
    ".ply": lambda path: read_ply(path, AGAIN),
    ".spz": gsply_files.read_spz,
    ".sog": read_sog,
}


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
