"""Files of scenes: lists, names and sizes of images, JSON, and folders of cached results."""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import unicodedata
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import write_text
from p2gs_jax.core.text import as_clock, first_few, parse_json
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.convert.readers import CONVERTED_SUFFIXES, size_of
from p2gs_jax.scene.lens import scale_intrinsics
from p2gs_jax.types import View

IMAGE_SUFFIXES = CONVERTED_SUFFIXES | {".jpg", ".jpeg", ".jfif", ".jp2", ".png", ".tif", ".tiff"}
IMAGE_SUFFIXES |= {".bmp", ".pgm", ".ppm"}
# Folders of masks. Masks beside photographs are recognised by names: `a_mask`, `a.mask`, `mask_a`.
MASK_FOLDERS = ("masks", "mask", "dynamic_masks", "dynamic_mask")
# Folders of pictures that are neither masks nor photographs.
MAP_FOLDERS = ("depth", "depths", "normal", "normals")
_MASK_NAME = re.compile(r"^(dynamic_)?masks?[._-](?=.)|(?<=.)[._-](dynamic_)?masks?$")
_TWO_SUFFIXES = re.compile(r"\.(jpe?g|png)\.png$", re.IGNORECASE)
# Largest distance of a principal point from the image centre, as a fraction of the sides.
MOST_OFF = 0.25
# Numbers from this size on count as infinite: float32 arithmetic may overflow.
HUGE = 1e30
_MOVE_INSIDE = "move it there, or name the folder of all photographs with --images"
# Pillow refuses larger pictures as an attack.
MOST_PIXELS = 2 * (Image.MAX_IMAGE_PIXELS or 2**26)
_MARKER = "finished"
# Number of bytes at the start of a photograph in which its XMP is searched.
_XMP_WITHIN = 2**18
# Time between two progress messages, seconds.
EVERY_S = 10.0

Report = Callable[[str], None]
"""Receives progress, a line at a time."""


def list_images(folder: Path, *, recursive: bool = True) -> list[Path]:
    """Return the photographs in a folder, sorted by relative path; none if it does not exist.

    Hidden files are left out, and so are masks (in a folder of masks, or named after a photograph),
    depth maps and normal maps. Raises OSError: a folder cannot be read.
    """
    return images_and_maps(folder, recursive=recursive)[0]


def images_and_maps(folder: Path, *, recursive: bool) -> tuple[list[Path], list[Path]]:
    """Return the results of `list_images`, and the depth and normal maps that it leaves out."""
    pictures = _pictures(folder, recursive)
    maps = [folder / p for p in pictures if _is_in(p, MAP_FOLDERS)]
    outside = [p for p in pictures if not _is_in(p, MASK_FOLDERS + MAP_FOLDERS)]
    named = {p for p in outside if named_as_mask(p.name)}
    photos = {name_without_mask(p.as_posix()) for p in outside if p not in named}
    always = {p for p in named if p.name.lower().startswith("dynamic_mask")}
    masks = always | {p for p in named if name_without_mask(p.as_posix()) in photos}
    images = [folder / p for p in sorted({*outside} - masks, key=lambda p: p.as_posix())]
    return images, maps


def _pictures(folder: Path, recursive: bool) -> list[Path]:
    """Return the paths of visible pictures relative to a folder; none if it does not exist."""
    if not folder.is_dir():
        return []
    files = files_below(folder) if recursive else folder.iterdir()
    found = (p for p in files if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    relative = (p.relative_to(folder) for p in found)
    return [p for p in relative if not any(part.startswith(".") for part in p.parts)]


def _is_in(path: Path, names: Sequence[str]) -> bool:
    return not {part.lower() for part in path.parts[:-1]}.isdisjoint(names)


def files_below(folder: Path, above: tuple[Path, ...] = ()) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders; links are followed, but not in a circle.

    `above` holds the true paths of the folders that led here. Raises OSError: a folder cannot be
    read; `filename` names it.
    """
    above = (*above, folder.resolve())
    for path in folder.iterdir():
        if not path.is_dir():
            yield path
        elif not any(place.is_relative_to(path.resolve()) for place in above):
            yield from files_below(path, above)


def named_as_mask(name: str) -> bool:
    """Return whether a file, judged by its name, may be a mask; `a.jpg.png` may be one."""
    return _MASK_NAME.search(_bare(name)) is not None or _TWO_SUFFIXES.search(name) is not None


def name_without_mask(name: str) -> str:
    """Return the part that the names of a photograph and its mask share.

    It is the relative path in lower case without image suffixes and words for masks.
    """
    path = PurePosixPath(name)
    return path.with_name(_bare(_MASK_NAME.sub("", _bare(path.name)))).as_posix().lower()


def _bare(name: str) -> str:
    """Return the name of a file in lower case without its image suffixes."""
    name = unicodedata.normalize("NFC", name).lower()
    while PurePosixPath(name).suffix in IMAGE_SUFFIXES:
        name = name[: name.rindex(".")]
    return name


def read_json(path: Path, fix: str) -> Any:
    """Return the content of a JSON file; UserError: it is absent, not text, or not valid JSON."""
    try:
        return parse_json(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise broken(path, "does not exist", fix) from None
    except json.JSONDecodeError as error:
        why = f"is not valid JSON: {error.msg} in line {error.lineno}, column {error.colno}"
        raise broken(path, why, fix) from None
    except (OSError, UnicodeDecodeError):
        raise broken(path, "is not a text file", fix) from None


def find_names(names: Iterable[str], folder: Path) -> dict[str, str]:
    """Return the file below a folder for each name; names without such a file are left out.

    The file may differ in case, Unicode form or suffix, or lie in another subfolder, if it is the
    only such file and no other name fits it. The longest common end of their paths decides.
    """
    found = {name: name for name in names if (folder / name).is_file()}
    left = [name for name in dict.fromkeys(names) if name not in found]
    files = {path.relative_to(folder).as_posix() for path in list_images(folder) if left}
    return found | alike_names(left, files - set(found.values()))


def alike_names(names: Iterable[str], files: Collection[str]) -> dict[str, str]:
    """Return the file that each name means; names that mean none or several are left out.

    A file may differ from the name as in `find_names`.
    """
    found: dict[str, str] = {}
    left = list(dict.fromkeys(names))
    deepest = max((name.count("/") + 1 for name in left), default=0)
    for alike in (str, _folded, _stem, *map(_end_of, range(deepest, 0, -1))):
        there: dict[str, list[str]] = defaultdict(list)
        rest = set(files) - set(found.values())
        for file in sorted(rest, key=lambda f: (not f.endswith(".png"), f)):
            there[alike(file)].append(file)
        wanted = Counter(map(alike, left))
        for name in left:
            like = there.get(alike(name), [])
            # A name without suffix (Blender's scenes) may fit several files: PNG first.
            alone = len(like) == 1 or (like and _stem(name) == _folded(name))
            if alone and wanted[alike(name)] == 1:
                found[name] = like[0]
        left = [name for name in left if name not in found]
    return found


def nearly_named(files: Mapping[str, str], source: str) -> list[str]:
    """Return a note about names whose files have slightly different names, or no note."""
    other = [f"{file} for {n}" for n, file in files.items() if PurePath(n).suffix and file != n]
    note = f"{len(other)} images named by {source} have nearly these names: {first_few(other)}"
    return [note] if other else []


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _end_of(count: int) -> Callable[[str], str]:
    """Return the function from a name to the last parts of its path, case-folded."""
    return lambda name: "/".join(_folded(name).split("/")[-count:])


def _stem(name: str) -> str:
    """Return a case-folded name without its image suffix."""
    path = PurePath(_folded(name))
    return (path.with_suffix("") if path.suffix in IMAGE_SUFFIXES else path).as_posix()


def require_inside(name: PurePath, folder: Path, source: Path, fix: str = _MOVE_INSIDE) -> None:
    """Raise UserError if a name in the file `source` leads out of the folder it is relative to.

    Symbolic links below the folder are followed: the owner of the folder made them.
    """
    normal = os.path.normpath(name.as_posix())
    if os.path.isabs(normal) or normal.split("/")[0] == "..":
        raise broken(source, f"names {name}, which lies outside {folder}", fix)


def require_plain(name: str, source: Path) -> None:
    """Raise UserError if a camera's name in the file `source` is not a valid folder name."""
    if name in ("", ".", "..") or any(c in name for c in "/\\\0"):
        why = f"names a camera {name!r}, which is not a valid folder name"
        raise broken(source, why, "get its tables again, or rename the camera in all of them")


def image_folder(root: Path, cfg: DataConfig) -> Path | None:
    """Return the image folder that the user names, or None; UserError: it does not exist."""
    folder = None if cfg.images is None else root / cfg.images
    if folder is not None and not folder.is_dir():
        raise broken(f"the image folder {folder}", "does not exist", "correct the option --images")
    return folder


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) as stored, before any EXIF rotation.

    Raises UserError: it is not an image, or too large; its name is not UTF-8; a package is missing.
    Raises OSError: it may not be read.
    """
    try:
        str(path).encode()  # the files of a run hold names in UTF-8
    except UnicodeEncodeError:
        raise UserError(f"the name of {path} is not UTF-8", fix="rename it") from None
    width, height = size_of(path) or _size_in_header(path)
    if width * height > MOST_PIXELS:
        fix = "make the photographs smaller, or remove that one from the scene"
        raise broken(path, f"has more than {MOST_PIXELS / 1e6:.0f} million pixels", fix)
    return width, height


def _size_in_header(path: Path) -> tuple[int, int]:
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            return image.size
    except Image.DecompressionBombError:
        return MOST_PIXELS, 2
    except Exception:  # PIL's error types are not a closed set
        pass
    with contextlib.suppress(cv2.error, OSError):
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is not None:
            return pixels.shape[1], pixels.shape[0]
    raise undecodable(path)


def decode_grey(data: bytes, shrink: int) -> UInt8[np.ndarray, "h w"] | None:
    """Return the photograph in the bytes of a file, grey and not rotated; None: it is broken.

    It is shrunk by 4, or by 2, if `shrink` is at least that: JPEG decodes faster then.
    """
    flags = {2: cv2.IMREAD_REDUCED_GRAYSCALE_2, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4}
    flag = flags.get(2 ** min(int(np.log2(max(shrink, 1))), 2), cv2.IMREAD_GRAYSCALE)
    with contextlib.suppress(cv2.error):  # OpenCV raises it for an empty file
        return cv2.imdecode(np.frombuffer(data, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)
    return None


def is_panorama(path: Path) -> bool:
    """Return whether a photograph of the ratio 2:1 shows a whole sphere (equirectangular).

    Its XMP states this. Or its first and last columns differ less than 2 times as much as
    neighbours do, and its outer rows vary less than a tenth as much as the image.
    """
    width, height = image_size(path)
    if width != 2 * height:
        return False
    data = path.read_bytes()
    grey = decode_grey(data, shrink=4)
    if grey is None or b"equirectangular" in data[:_XMP_WITHIN].lower():
        return grey is not None
    values = grey.astype(np.float32)
    steps = np.abs(np.roll(values, 1, axis=1) - values).mean(axis=0)
    closed = steps[0] < 2 * max(float(steps.mean()), 1.0)
    return bool(closed and values[[0, -1]].std(axis=1).max() < values.std() / 10)


def undecodable(path: Path) -> UserError:
    """Return the error for a file that is not an image; OSError: it may not be read."""
    size = path.stat().st_size if path.is_file() else 0
    if size:
        path.open("rb").close()
    fix = "copy or export that photograph again, or remove it from the scene"
    return broken("cannot decode the image", f"{path} ({size} bytes)", fix)


def check_missing(
    missing: Sequence[str], total: int, source: Path, cfg: DataConfig, folder: Path | None = None
) -> list[str]:
    """Return notes about missing images of a model that names `total` images.

    They were searched in `folder`. Raises UserError: images are missing and `allow_missing` is not
    set, or no image is left.
    """
    if not missing:
        return []
    message = f"{len(missing)} of the {total} images named by {source} do not exist: "
    message += first_few(missing)
    if folder is not None:
        files = [path.relative_to(folder).as_posix() for path in list_images(folder)]
        nearest = difflib.get_close_matches(missing[0], files, 1, 0.0)
        near = f"; the nearest name is {nearest[0]}" if nearest else ""
        message += f"; {folder} holds {len(files)} images{near}"
    if not cfg.allow_missing:
        fix = "add them, name their folder with --images, or skip them with --data.allow-missing"
        raise UserError(message, fix=fix)
    if len(missing) == total:
        raise UserError(message, fix="point --images at the folder that holds them")
    return [f"skipped: {message}"]


def at_file_size(
    path: Path, K: Float[np.ndarray, "3 3"], size: tuple[int, int], source: Path
) -> tuple[Float32[np.ndarray, "3 3"], int, int]:
    """Return K, width and height of an image file, given the model's K and size (pixels).

    Raises UserError: the file is not an image, or has another aspect ratio than `source` states.
    """
    w, h = image_size(path)
    if not same_aspect((w, h), size):
        why = f"is {w}x{h}, but {source} states {size[0]}x{size[1]}"
        fix = "use the photographs from which the model was made, neither cropped nor rotated"
        raise broken(f"wrong size: {path}", why, fix)
    return scale_intrinsics(K, w / size[0], h / size[1]).astype(np.float32), w, h


def same_aspect(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Return whether two sizes have the same aspect; sides of `a` may be rounded by a pixel."""
    sides = np.array(a) / b, 1 / np.array(b)
    return bool((sides[0] - sides[1]).max() <= (sides[0] + sides[1]).min())


def rescaled(count: int, source: str) -> list[str]:
    """Return a note about the number of resized images, or no note."""
    note = f"{count} images have another size than {source} states: intrinsics were rescaled"
    return [note] if count else []


@contextmanager
def cached_folder(
    work_dir: Path | None, name: str, key: object, build: Callable[[Path], None]
) -> Iterator[Path]:
    """Provide a folder that `build` has filled, now or in an earlier run.

    `key` holds everything the result depends on, as JSON. A folder is finished if it has a marker
    with the hash of `key`; otherwise it is emptied and filled again. If `work_dir` is None, the
    folder is temporary.
    """
    if work_dir is None:
        with tempfile.TemporaryDirectory(prefix="p2gs_") as temporary:
            build(Path(temporary))
            yield Path(temporary)
        return
    folder = work_dir / name
    marker = folder / _MARKER
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()
    if not (marker.is_file() and marker.read_text().strip() == digest):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        build(folder)
        write_text(marker, digest)
    yield folder


def file_fingerprints(paths: Sequence[Path]) -> list[tuple[str, int, int]]:
    """Return (path, size in bytes, modification time in ns) of every file."""
    stats = [(path, path.stat()) for path in paths]
    return [(str(path.resolve()), stat.st_size, stat.st_mtime_ns) for path, stat in stats]


def recognition_key(views: Iterable[View], known: str | None) -> str:
    """Return a hash of what a fit may not change on the way; copies of the files have the same.

    It covers names and file sizes of photographs and masks, the split, the cameras and the file of
    known exposures, if `known` names one.
    """

    def facts(view: View) -> list[Any]:
        paths = view.image_path, view.mask_path
        sizes = [p.stat().st_size if p and p.exists() else None for p in paths]
        # Another processor may round the last digits otherwise.
        camera = [(np.round(m, 4) + 0.0).tolist() for m in (view.viewmat, view.K)]
        return [view.name, sizes, view.split, camera, view.distortion]

    table = Path(known).read_bytes() if known and Path(known).is_file() else None
    return hashlib.sha256(repr([*map(facts, views), table]).encode()).hexdigest()[:16]


def stage_progress(report: Report, stage: str, total: int, unit: str) -> Callable[[int], None]:
    """Begin a stage, such as "matching" 100 "image pairs"; return a function that reports progress.

    Its argument is the number done. The first message comes at once, then one every `EVERY_S` s.
    """
    begin = last = time.monotonic()
    if total:
        report(f"{stage}: {total} {unit}")

    def progress(done: int) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last < EVERY_S or not 0 < done < total:
            return
        last = now
        left = as_clock(round((now - begin) / done * (total - done)))
        report(f"{stage}: {done} of {total} {unit}, about {left} left")

    return progress
