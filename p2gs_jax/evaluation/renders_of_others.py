"""Renders of held-out views that any program wrote: which file shows which view, and its pixels.

docs/comparing.md describes the layouts.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from p2gs_jax.core.text import natural
from p2gs_jax.errors import UserError
from p2gs_jax.formats.exr import read_exr_with_alpha
from p2gs_jax.types import Scene

# Display values come first: a program that writes both developed them itself.
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")
# Where pictures by name lie below the folder given: here, nerfstudio's `ns-render dataset`, others.
PLACES = (".", "rgb", "test/rgb", "renders", "test/renders", "test")
# Luminance-GS, whose views are in that order as well; beside these pictures are dark ones.
LUMINANCE_GS = re.compile(r"val_(?P<step>)(?P<k>\d+)_enh")
# gsplat's trainer writes photograph and render side by side, in the order of held-out views.
GSPLAT = re.compile(r"(?:val|test)_step(?P<step>\d+)_(?P<k>\d+)")


class Rendered(NamedTuple):
    """What a file holds: display values in [0, 1], or linear radiance."""

    pixels: Float32[np.ndarray, "h w 3"]
    linear: bool
    alpha: Float32[np.ndarray, "h w"] | None  # by which radiance is premultiplied, if it has any


@dataclass(frozen=True)
class OtherRenders:
    """The files of a folder that show held-out views, by the rows of these."""

    folder: Path
    layout: str  # in words
    files: dict[int, Path]
    missing: tuple[str, ...] = ()  # names of held-out views that no file shows
    of_training: int = 0  # files that show training views
    unknown: int = 0  # files that show no view
    numbered: bool = False  # in the order of held-out views; their names say no more
    right_half: bool = False  # the photograph is to the left of the render in each file

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is to be said of it, in sentences."""
        said = []
        if self.missing:
            shown = ", ".join(self.missing[:5]) + (", ..." if len(self.missing) > 5 else "")
            said.append(
                f"{self.folder} lacks {len(self.missing)} of "
                f"{len(self.missing) + len(self.files)} held-out views ({shown}): this run is "
                f"judged over the other {len(self.files)} as well."
            )
        if self.of_training or self.unknown:
            said.append(
                f"{self.folder}: {self.of_training} files show training views and {self.unknown} "
                "no view of the scene; they are not judged."
            )
        return tuple(said)

    def read(self, row: int, size: tuple[int, int], over: bool = False) -> Rendered:
        """Return the render of a view, which must have a size of (width, height) pixels.

        With `over` it is to be put over a background: radiance must then have an opacity.

        Raises:
            UserError: it cannot be read, has another size, or holds what is not a colour.
        """
        path = self.files[row]
        linear, alpha = path.suffix.lower() == ".exr", None
        if linear:
            pixels, alpha, _ = read_exr_with_alpha(path)
        else:
            pixels = _read_display(path)
        height, width = pixels.shape[:2]
        if self.right_half and width == 2 * size[0]:
            pixels, width = pixels[:, size[0] :], size[0]
        if (width, height) != size:
            raise UserError(
                f"{path} is {width}x{height}, the run's view {size[0]}x{size[1]}.",
                fix="render it at the size that the run was fitted at, or fit the run at that of "
                "the renders (--max-width)",
            )
        if linear and over and alpha is None:
            raise UserError(
                f"{path} has no channel A, and the scene's photographs are shown over a "
                "background.",
                fix="write the opacity of the render as well, or pictures over that background",
            )
        if not np.isfinite(pixels).all():
            bad = int((~np.isfinite(pixels)).any(-1).sum())
            raise UserError(
                f"{path} has {bad} pixels that are infinite or not a number.", fix="render it again"
            )
        return Rendered(pixels, linear, alpha)


def _read_display(path: Path) -> Float32[np.ndarray, "h w 3"]:
    try:
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error):
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise UserError(
            f"{path} cannot be read as a picture of 8 or 16 bits.",
            fix="write it again as PNG or JPEG",
        )
    most = np.iinfo(pixels.dtype).max
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, -1)
    if pixels.shape[-1] == 4 and (pixels[..., 3] < most).any():
        raise UserError(
            f"{path} is transparent in places.", fix="write it over the background that was meant"
        )
    return pixels[..., 2::-1].astype(np.float32) / most


def find_renders(folder: str | Path, scene: Scene) -> OtherRenders:
    """Return which files of a folder show which held-out views.

    Looked for in this order: pictures with the names of views, here or in one of `PLACES`; those
    of the 3DGS code (`test/ours_N/renders`, the largest N; before pictures by name), of gsplat's
    trainer or Luminance-GS, or bare numbers here: all the held-out views in the order of names.

    Raises:
        UserError: the scene holds nothing out, the folder holds no render, or numbered ones whose
            count is another than that of the held-out views.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder.", fix="give --against a folder of renders")
    if not scene.test_indices:
        raise UserError(
            "the run holds no view out, and renders are compared on held-out views.",
            fix="fit with --test-every 8",
        )
    numbered = _of_3dgs(folder)
    if numbered is None:
        by_name = (_by_name(folder, folder / place, scene) for place in PLACES)
        found = next(filter(None, by_name), None)
        if found is not None:
            return found
        numbered = _of_trainers(folder)
        if numbered is None and (bare := _numbers(folder)):
            numbered = ("numbered pictures", bare, False)
    if numbered is None:
        raise UserError(
            f"{folder} holds no render of a held-out view (for example "
            f"{Path(scene.views[scene.test_indices[0]].name).with_suffix('.png')}).",
            fix="name pictures as the scene's views, or keep the folder as the 3DGS code or gsplat "
            "wrote it (docs/comparing.md)",
        )
    layout, files, right_half = numbered
    if len(files) != len(scene.test_indices):
        raise UserError(
            f"{files[0].parent} holds {len(files)} numbered renders, the run holds "
            f"{len(scene.test_indices)} views out.",
            fix="hold out the same views in both programs (--test-every), or name the renders as "
            "the views",
        )
    rows = orders(scene)[0]
    by_row = dict(zip(rows, files, strict=True))
    return OtherRenders(folder, layout, by_row, numbered=True, right_half=right_half)


def orders(scene: Scene) -> list[tuple[int, ...]]:
    """Return the orders in which programs number held-out views, without doubles.

    As text, as 3DGS and gsplat do; and with numbers in names counted (2 before 10), which is the
    order that the files of NeRF-synthetic have.
    """
    rows = sorted(scene.test_indices, key=lambda row: scene.views[row].name)
    counted = sorted(rows, key=lambda row: natural(scene.views[row].name))
    return list(dict.fromkeys((tuple(rows), tuple(counted))))


def in_order(found: OtherRenders, order: Sequence[int]) -> OtherRenders:
    """Return numbered renders as views in another order."""
    return replace(found, files=dict(zip(order, found.files.values(), strict=True)))


def _by_name(folder: Path, place: Path, scene: Scene) -> OtherRenders | None:
    if not place.is_dir():
        return None
    files = {
        p.relative_to(place).as_posix(): p
        for p in sorted(place.rglob("*"))
        if p.is_file() and p.suffix.lower() in SUFFIXES and not p.name.startswith(".")
    }
    claimed: dict[int, list[str]] = {}
    for row, view in enumerate(scene.views):
        stem = Path(view.name).with_suffix("").as_posix()
        names = [f"{stem}.render.png", *(stem + s for s in SUFFIXES), view.name]
        names += [stem + s.upper() for s in SUFFIXES]
        claimed[row] = [n for n in dict.fromkeys(names) if n in files]
    held_out = {row: files[claimed[row][0]] for row in scene.test_indices if claimed[row]}
    if not held_out:
        return None
    stems = {Path(v.name).with_suffix("").as_posix() for v in scene.views}
    # What p2gs-jax writes beside a render.
    beside = {f"{s}.photograph.png" for s in stems} | {
        n for names in claimed.values() for n in names
    }
    return OtherRenders(
        folder,
        "pictures by name",
        held_out,
        tuple(scene.views[row].name for row in scene.test_indices if not claimed[row]),
        sum(bool(claimed[row]) for row in scene.train_indices),
        len(files.keys() - beside),
    )


_Numbered = tuple[str, list[Path], bool]


def _of_3dgs(folder: Path) -> _Numbered | None:
    """Return the pictures that `render.py` of the 3DGS code wrote last, if it wrote any."""
    runs = [folder, *folder.glob("ours_*"), *folder.glob("test/ours_*")]
    if folder.name == "renders":
        runs.append(folder.parent)
    runs = [r for r in runs if re.fullmatch(r"ours_\d+", r.name) and (r / "renders").is_dir()]
    if not runs:
        return None
    last = max(runs, key=lambda r: int(r.name[5:]))
    files = _numbers(last / "renders")
    return (f"3DGS, {last.name}", files, False) if files else None


def _of_trainers(folder: Path) -> _Numbered | None:
    """Return the pictures of gsplat's last evaluation, or of Luminance-GS, if there are any."""
    for pattern, layout, beside in (
        (GSPLAT, "gsplat, step {}", True),
        (LUMINANCE_GS, "Luminance-GS, enhanced", False),
    ):
        found: dict[int, list[tuple[int, Path]]] = {}
        for place in (folder, folder / "renders"):
            for path in place.glob("*.png"):
                if match := pattern.fullmatch(path.stem):
                    found.setdefault(int(match["step"] or 0), []).append((int(match["k"]), path))
        if found:
            last = max(found)
            return layout.format(last), [path for _, path in sorted(found[last])], beside
    return None


def _numbers(folder: Path) -> list[Path]:
    named = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.stem.isdecimal()]
    return sorted(named, key=lambda p: int(p.stem))
