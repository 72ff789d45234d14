"""Renders of held-out views by any program: the file of each view, and its pixels.

docs/report.md describes the layouts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from p2gs_jax.core.text import first_few, stems
from p2gs_jax.errors import UserError
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.scene.files import files_below
from p2gs_jax.types import Scene

# Display values come first: if a program also writes radiance, they alone have its tone curve.
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")


class Rendered(NamedTuple):
    """Content of a file: display values in [0, 1], or linear radiance."""

    pixels: Float32[np.ndarray, "h w 3"]
    linear: bool
    alpha: Float32[np.ndarray, "h w"] | None  # opacity by which radiance is premultiplied, or None


@dataclass(frozen=True)
class OtherRenders:
    """The files of a folder that show held-out views, by row of the view."""

    folder: Path
    layout: str
    files: dict[int, Path]
    missing: tuple[str, ...] = ()  # names of held-out views without a file

    @property
    def remark(self) -> str | None:
        """A note for the user on missing views, or None."""
        if not self.missing:
            return None
        return (
            f"{self.folder} lacks {len(self.missing)} of {len(self.missing) + len(self.files)} "
            f"held-out views ({first_few(self.missing)}): the scores of this run are also over "
            f"the other {len(self.files)}."
        )

    def read(self, row: int, size: tuple[int, int], over: bool = False) -> Rendered:
        """Return the render of a view, which must have a size of (width, height) pixels.

        With `over` the photographs are over a background: radiance must then have an opacity.
        Raises UserError: the file cannot be read, has another size, lacks an opacity, or holds
        values that are not finite.
        """
        path = self.files[row]
        linear, alpha = path.suffix.lower() == ".exr", None
        if linear:
            pixels, alpha, _ = read_exr(path)
        else:
            pixels = read_display(path)
        height, width = pixels.shape[:2]
        if (width, height) != size:
            why = f"{path} is {width}x{height} pixels, but the run's view {size[0]}x{size[1]}."
            fix = "render it at the size of the run, or fit the run at the size of the renders "
            fix += "(--max-width)"
            raise UserError(why, fix=fix)
        if linear and over and alpha is None:
            why = f"{path} has no channel A, but the photographs of the scene are over a "
            why += "background."
            fix = "write the opacity of the render as well, or pictures over that background"
            raise UserError(why, fix=fix)
        if not np.isfinite(pixels).all():
            bad = int((~np.isfinite(pixels)).any(-1).sum())
            fix = "render it again"
            raise UserError(f"{path} has {bad} pixels that are infinite or not a number.", fix=fix)
        return Rendered(pixels, linear, alpha)


def read_display(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Return display values of an opaque PNG or JPEG; raises UserError if it cannot be read."""
    try:
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error):
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        fix = "write it again as PNG or JPEG"
        raise UserError(f"{path} cannot be read as a picture of 8 or 16 bits.", fix=fix)
    most = np.iinfo(pixels.dtype).max
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, -1)
    if pixels.shape[-1] == 4 and (pixels[..., 3] < most).any():
        fix = "write it over the background of the photographs"
        raise UserError(f"{path} is transparent in places.", fix=fix)
    return pixels[..., 2::-1].astype(np.float32) / most


def find_renders(folder: str | Path, scene: Scene) -> OtherRenders:
    """Return the files of a folder that show held-out views.

    Pictures have the names of views, or are numbered in the order of names of held-out views.
    Raises UserError: there are no held-out views, the folder is absent or holds no render, or the
    number of numbered renders is not the number of held-out views.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder.", fix="give --against a folder of renders")
    if not scene.test_indices:
        why = "the run has no held-out views, on which renders are compared."
        raise UserError(why, fix="fit with --test-every 8")
    names, named = {row: scene.views[row].name for row in scene.test_indices}, _by_name(folder)
    all_stems = stems([view.name for view in scene.views])
    files: dict[int, Path] = {}
    for row in names:
        stem = all_stems[row]
        found = [stem + suffix for suffix in (".render.png", *SUFFIXES) if stem + suffix in named]
        if found:
            files[row] = named[found[0]]
    if files:
        missing = tuple(name for row, name in names.items() if row not in files)
        return OtherRenders(folder, "pictures by name", files, missing)
    numbered = sorted((p for p in named.values() if p.stem.isdecimal()), key=lambda p: int(p.stem))
    if not numbered:
        why = f"{folder} holds no render of a held-out view (for example "
        why += f"{Path(min(names.values())).with_suffix('.png')})."
        fix = "name pictures as the scene's views, or number them in the order of these names"
        raise UserError(why, fix=fix)
    if len(numbered) != len(names):
        why = f"{folder} holds {len(numbered)} numbered renders, but the run has {len(names)} "
        why += "held-out views."
        fix = "hold out the same views in both programs (--test-every), or name the renders as "
        fix += "the views"
        raise UserError(why, fix=fix)
    rows = sorted(names, key=lambda row: names[row])
    return OtherRenders(folder, "numbered pictures", dict(zip(rows, numbered, strict=True)))


def _by_name(folder: Path) -> dict[str, Path]:
    """Return the pictures, except hidden ones, by relative path with a lower-case suffix."""
    found = (p for p in sorted(files_below(folder)) if p.suffix.lower() in SUFFIXES and p.is_file())
    return {
        p.relative_to(folder).with_suffix(p.suffix.lower()).as_posix(): p
        for p in found
        if not p.name.startswith(".")
    }
