"""HEIC, camera raw and files of linear light, converted once to PNG in the run's cache."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import shutil
import struct
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import platformdirs
from jaxtyping import UInt
from PIL import ExifTags, Image

from p2gs_jax.core.atomic import atomic_write, write_text
from p2gs_jax.core.text import count_of
from p2gs_jax.errors import broken
from p2gs_jax.scene.convert import readers
from p2gs_jax.scene.convert.icc import encode_16
from p2gs_jax.scene.convert.readers import Balance, Kind, Picture, kind_of
from p2gs_jax.scene.files import Report, cached_folder, file_fingerprints
from p2gs_jax.scene.masks import find_masks
from p2gs_jax.types import Scene

# The version is part of the key of the cached folder: raise it whenever results change.
_VERSION = 3
_FOLDER, _RECORD = "developed", "photographs.json"
_NAMES: dict[Kind, str] = {
    "raw": "camera raw",
    "heif": "HEIC",
    "avif": "AVIF",
    "webp": "WebP",
    "exr": "linear EXR",
}
# If one photograph has two files, the first of these kinds is used: earlier kinds keep more light.
_RANK: tuple[Kind, ...] = ("exr", "raw", "heif", "avif", "webp", "plain")
# EXR files have no white point: they are scaled until this percentage of each one's pixels is below
# 1, unless the largest of these percentiles lies between _DARK and 1 already.
_BRIGHT, _DARK = 99.9, 0.25
# PNG's level of compression: a better one saves 10 % of the space and takes 5 times as long.
_COMPRESSION = 1
_SIGNATURE_AND_HEADER = 8 + 25  # bytes of a PNG
# EXIF tags that are copied: make and model.
_KEPT = (0x010F, 0x0110)
# Exposure time, f-number, sensitivities, date, zoom, serial and lens.
_KEPT_EXIF = (
    *(0x829A, 0x829D, 0x8827, 0x8830, 0x8831, 0x8832, 0x8833),
    *(0x9003, 0x9011, 0x9291, 0x920A, 0xA404, 0xA405, 0xA431, 0xA434),
)
_NO_ROOM = "free space on that disk, or name another --out"


@dataclass(frozen=True)
class Converted:
    """Photographs that structure from motion can read, sorted, in `folder`."""

    folder: Path
    paths: list[Path]
    originals: Mapping[str, Path]  # the user's files, by path relative to `folder`
    notes: tuple[str, ...] = ()
    known: str | None = None  # the reason why the tone curve of all photographs is known


def convert_photographs(
    folder: Path, paths: Sequence[Path], work_dir: Path | None, report: Report
) -> Converted:
    """Return the photographs of a folder as files that every module can read.

    If a file needs conversion, all are written to `work_dir`, or the user's cache if it is None.
    Raises UserError: a photograph cannot be decoded, or a package for it is missing.
    """
    kinds, notes = _without_twins({path: kind_of(path) for path in paths})
    names = {path: path.relative_to(folder).as_posix() for path in kinds}
    if all(kind == "plain" for kind in kinds.values()):
        originals = {name: path for path, name in names.items()}
        return Converted(folder, sorted(kinds), originals, tuple(notes))
    places = {
        path: name if kinds[path] == "plain" else Path(name).with_suffix(".png").as_posix()
        for path, name in names.items()
    }
    target, more, known = _converted(folder, kinds, places, work_dir, report)
    paths = sorted((target / place for place in places.values()), key=lambda p: p.as_posix())
    originals = {place: path for path, place in places.items()}
    return Converted(target, paths, originals, (*notes, *more), known)


def with_originals(scene: Scene, converted: Converted) -> Scene:
    """Return a scene of converted photographs with the names and notes of the user's files.

    Plain photographs are read at their original place, so that a run folder can move.
    """
    views, originals = [], []
    for view in scene.views:
        original = converted.originals[view.name]
        plain = original.suffix == Path(view.name).suffix
        name = Path(view.name).with_suffix(original.suffix).as_posix()
        path = original if plain else converted.folder / view.name
        originals.append(dataclasses.replace(view, name=name, image_path=original))
        views.append(dataclasses.replace(view, name=name, image_path=path))
    # Masks lie beside the original photographs.
    masks, _ = find_masks(originals, scene.root)
    views = [dataclasses.replace(v, mask_path=m) for v, m in zip(views, masks, strict=True)]
    notes = (*scene.notes, *converted.notes)
    known = converted.known
    return dataclasses.replace(scene, views=tuple(views), notes=notes, known_response=known)


def converted_views(scene: Scene, work_dir: Path | None, report: Report) -> Scene:
    """Return a scene whose views show converted photographs if its files need conversion.

    Converted files are cached in `work_dir`, or the user's cache. Raises UserError: a photograph
    cannot be decoded, or a package for it is missing.
    """
    kinds: dict[Path, Kind] = {v.image_path: kind_of(v.image_path) for v in scene.views}
    # `.png` is added: names may differ in their suffix alone.
    places = {v.image_path: v.name + ".png" for v in scene.views if kinds[v.image_path] != "plain"}
    if not places:
        return scene
    target, notes, known = _converted(scene.root, kinds, places, work_dir, report)
    paths = {path: target / place for path, place in places.items()}
    views = tuple(
        dataclasses.replace(view, image_path=paths.get(view.image_path, view.image_path))
        for view in scene.views
    )
    notes = (*scene.notes, *notes)
    return dataclasses.replace(scene, views=views, notes=notes, known_response=known)


def cache_of(root: Path, work_dir: Path | None) -> Path:
    """Return the folder for cached files of a scene: the run's cache, or else the user's."""
    if work_dir is not None:
        return work_dir
    scene = hashlib.sha256(str(root.resolve()).encode()).hexdigest()[:16]
    return platformdirs.user_cache_path("p2gs-jax") / "photographs" / scene


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"{n} {name}" for name, n in Counter(names).most_common())


def _without_twins(kinds: dict[Path, Kind]) -> tuple[dict[Path, Kind], list[str]]:
    """Return one file for each photograph (cameras may write raw and JPEG), and notes."""
    shots: dict[Path, list[Path]] = defaultdict(list)
    for path in kinds:
        shots[path.with_suffix("")].append(path)
    readable = {"raw": find_spec("rawpy"), "heif": find_spec("pillow_heif")}
    dropped: set[Path] = set()
    for files in shots.values():
        if any(kinds[path] != "plain" for path in files):
            usable = [path for path in files if readable.get(kinds[path], True)] or files
            best = min(usable, key=lambda path: (_RANK.index(kinds[path]), path.name))
            dropped.update(path for path in files if path != best)
    if not dropped:
        return kinds, []
    note = f"{count_of(len(dropped), 'file')} will not be read ({min(dropped).name}, ...), because "
    note += "the same photograph exists in another format."
    return {path: kind for path, kind in kinds.items() if path not in dropped}, [note]


def _converted(
    root: Path,
    kinds: Mapping[Path, Kind],
    places: Mapping[Path, str],
    work_dir: Path | None,
    report: Report,
) -> tuple[Path, list[str], str | None]:
    """Write photographs to their places in a cached folder.

    Returns the folder, notes, and the reason why the tone curve of all is known, or None.
    """
    names = list(places.values())
    key = {"version": _VERSION, "files": file_fingerprints(list(places)), "places": names}

    def build(folder: Path) -> None:
        record = _Converter({path: kinds[path] for path in places}).fill(folder, places, report)
        write_text(folder / _RECORD, json.dumps(record, indent=1))

    with cached_folder(cache_of(root, work_dir), _FOLDER, key, build) as folder:
        record = json.loads((folder / _RECORD).read_text())
    if not record["known"] or "plain" not in kinds.values():
        return folder, record["notes"], record["known"]
    listed = _listed(_NAMES.get(kind, "others") for kind in kinds.values())
    note = f"Photographs are of several kinds ({listed}): the tone curve is not known for all and "
    return folder, [*record["notes"], note + "is therefore solved."], None


class _Converter:
    """Converts photographs with one white balance a camera and one white point a scene."""

    def __init__(self, kinds: Mapping[Path, Kind]):
        self._kinds = kinds
        self._facts = {p: readers.read_facts(p) for p, kind in kinds.items() if kind == "raw"}
        self._chosen: dict[str, list[Balance]] = defaultdict(list)
        for facts in self._facts.values():
            if facts.balance is not None:
                self._chosen[facts.camera].append(facts.balance)
        # Each camera gets the median of its white balances.
        self._balances: dict[str, Balance] = {
            camera: tuple(np.exp(np.median(np.log(balances), axis=0)).tolist())
            for camera, balances in self._chosen.items()
        }
        self._scale = self._common_scale()

    def fill(self, folder: Path, places: Mapping[Path, str], report: Report) -> dict[str, Any]:
        """Write or link all photographs; return the record of the conversion."""
        records: list[dict[str, Any]] = []
        total = sum(self._kinds[path] != "plain" for path in places)
        for path, place in places.items():
            target = folder / place
            target.parent.mkdir(parents=True, exist_ok=True)
            if self._kinds[path] == "plain":
                _link(path.resolve(), target)
                continue
            if len(records) % 5 == 0:
                report(f"converting photographs: {len(records)} of {total}")
            records.append(self._write(path, target) | {"file": str(path), "converted": place})
        names = dict.fromkeys(_NAMES[r["kind"]] for r in records)
        known = ", ".join(names) if records and all(r["light"] for r in records) else None
        return {"known": known, "notes": self._notes(records), "photographs": records}

    def _common_scale(self) -> float:
        """Return the factor, a power of 2, by which EXR files are scaled."""
        brightest = 0.0
        for path, kind in self._kinds.items():
            if kind == "exr":
                light = self._read(path).light
                assert light is not None
                values = light[::3, ::3].max(2)
                values = values[values < readers.INFINITE]
                if values.size:
                    brightest = max(brightest, float(np.percentile(values, _BRIGHT)))
        if not brightest or _DARK <= brightest <= 1.001:
            return 1.0
        return 2.0 ** -math.ceil(math.log2(brightest))

    def _read(self, path: Path) -> Picture:
        if path in self._facts:
            return readers.read_raw(path, self._balances.get(self._facts[path].camera))
        return (readers.read_exr if self._kinds[path] == "exr" else readers.read_heif)(path)

    def _write(self, path: Path, target: Path) -> dict[str, Any]:
        """Convert one photograph; return its entry in the record."""
        picture, kind = self._read(path), self._kinds[path]
        record: dict[str, Any] = {"kind": kind, "light": picture.light is not None}
        if picture.light is None:
            assert picture.codes is not None
            write_png(target, picture.codes, picture.exif, picture.profile)
            return record
        scale = self._scale if kind == "exr" else 1.0
        light = picture.light * np.float32(scale)
        codes = encode_16(light)
        if picture.alpha is not None:
            alpha = np.rint(picture.alpha * 65535).astype(np.uint16)[..., None]
            codes = np.concatenate([codes, alpha], axis=2)
        write_png(target, codes, picture.exif)
        saturated = float((light >= 1).any(2).mean())
        record |= {"saturated": saturated, "invalid": picture.invalid, "scale": scale}
        if path in self._facts:
            facts = self._facts[path]
            record |= vars(facts) | {"applied_balance": self._balances.get(facts.camera)}
        return record

    def _notes(self, records: Sequence[Mapping[str, Any]]) -> list[str]:
        out = [f"Converted into the run's cache: {_listed(_NAMES[r['kind']] for r in records)}."]
        for camera, balance in self._balances.items():
            count = sum(f.camera == camera for f in self._facts.values())
            chosen = np.log2(self._chosen[camera])
            spread = float(np.ptp(chosen - chosen[:, 1:2], axis=0).max())
            out.append(
                f"White balance of {count} raw photographs ({camera or 'camera unknown'}): "
                f"red {balance[0]:.3f}, blue {balance[2]:.3f} for all, the median of the camera's "
                f"choices, which vary by {spread:.2f} EV."
            )
        counted = {
            "raw photographs record no white balance: LibRaw's daylight balance is used.": sum(
                f.balance is None for f in self._facts.values()
            ),
            "raw photographs come from a camera whose colours LibRaw does not know: they stay in "
            "the camera's primaries.": sum(not f.matrix for f in self._facts.values()),
            "pixels of linear photographs are not numbers; they count as black.": sum(
                r.get("invalid", 0) for r in records
            ),
        }
        out += [f"{n} {text}" for text, n in counted.items() if n]
        if self._scale != 1:
            note = f"All linear photographs were multiplied by {self._scale:g}, so that "
            out.append(f"{note}{_BRIGHT:g} % of the pixels of each are below white.")
        return out


def _link(source: Path, target: Path) -> None:
    """Link a file to another place, or copy it on file systems without symbolic links."""
    try:
        with contextlib.suppress(OSError):
            os.symlink(source, target)
            return
        shutil.copyfile(source, target)
    except OSError as error:
        why = f"cannot be copied to {target}: {error.strerror or error}."
        raise broken(source, why, _NO_ROOM) from None


def write_png(
    path: Path,
    pixels: UInt[np.ndarray, "h w c"],
    exif: Image.Exif | None = None,
    profile: bytes | None = None,
) -> None:
    """Write a converted photograph, uint8 or uint16 in the order R G B (A), or one channel.

    The settings in `exif` are copied without the orientation: poses belong to the stored raster.
    `profile` is an ICC profile, or None for sRGB. Raises UserError: the file cannot be written.
    """
    order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(pixels.shape[2], [0])
    raster = np.ascontiguousarray(pixels[..., order])
    good, data = cv2.imencode(".png", raster, [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION])
    assert good
    extra = b""
    if profile:
        extra += _chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(profile))
    if settings := kept_settings(exif):
        extra += _chunk(b"eXIf", settings)
    png, at = data.tobytes(), _SIGNATURE_AND_HEADER
    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(png[:at] + extra + png[at:])
    except OSError as error:
        why = f"cannot be written: {error.strerror or error}."
        raise broken(path, why, _NO_ROOM) from None


def kept_settings(exif: Image.Exif | None) -> bytes:
    """Return the copied EXIF settings in the format of PNG, empty if there are none."""
    out = Image.Exif()
    try:
        shot = {} if exif is None else exif.get_ifd(ExifTags.IFD.Exif)
        out.update({tag: exif[tag] for tag in _KEPT if exif is not None and tag in exif})
        if kept := {tag: shot[tag] for tag in _KEPT_EXIF if tag in shot}:
            out.get_ifd(ExifTags.IFD.Exif).update(kept)
        return out.tobytes().removeprefix(b"Exif\0\0") if kept or len(out) else b""
    except Exception:  # malformed EXIF raises many kinds of errors
        return b""


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
