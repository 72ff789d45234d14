"""Develops photographs that belong together: what they share, each of them, and a record of it."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.core.atomic import write_text
from p2gs_jax.errors import UserError
from p2gs_jax.scene.photographs.by_pillow import read_by_pillow
from p2gs_jax.scene.photographs.files import write_png
from p2gs_jax.scene.photographs.gain_maps import has_gain_map
from p2gs_jax.scene.photographs.heif import read_heif
from p2gs_jax.scene.photographs.kinds import Kind
from p2gs_jax.scene.photographs.linear import read_exr, read_float_tiff
from p2gs_jax.scene.photographs.picture import Picture
from p2gs_jax.scene.photographs.profiles import encode_16
from p2gs_jax.scene.photographs.raw import Balance, RawFacts, read_facts, read_raw

RECORD = "photographs.json"
NAMES: dict[Kind, str] = {
    "raw": "camera raw",
    "heif": "HEIC",
    "avif": "AVIF",
    "webp": "WebP",
    "exr": "linear EXR",
    "float_tiff": "TIFF of floats",
}
_LINEAR = ("exr", "float_tiff")
# Light of files without a white of their own: what fewer pixels exceed is saturated.
_BRIGHT = 99.9
_DARK = 0.25


class Darkroom:
    """Develops photographs that belong together.

    Args:
        kinds: of all.
        report: receives progress.
    """

    def __init__(self, kinds: Mapping[Path, Kind], report: Callable[[str], None]):
        self._kinds, self._report = kinds, report
        self._facts = {p: read_facts(p) for p, kind in kinds.items() if kind == "raw"}
        self._balances = _common_balances(self._facts.values())
        self._scale = self._white()

    def fill(self, folder: Path, places: Mapping[Path, str]) -> None:
        """Write all photographs, and a record of what was done."""
        records, done = [], 0
        total = sum(self._kinds[path] != "plain" for path in places)
        for path, place in places.items():
            target = folder / place
            target.parent.mkdir(parents=True, exist_ok=True)
            if self._kinds[path] == "plain":
                _link(path.resolve(), target)
                continue
            if done % 5 == 0:
                self._report(f"developing photographs: {done} of {total}")
            records.append(self._develop(path, target) | {"file": str(path), "developed": place})
            done += 1
        known = [r for r in records if r["light"]]
        names = dict.fromkeys(NAMES[r["kind"]] for r in known)
        said = {
            "known": ", ".join(names) if known and len(known) == len(records) else None,
            "notes": [*self._notes(records)],
            "photographs": records,
        }
        write_text(folder / RECORD, json.dumps(said, indent=1))

    def _white(self) -> float:
        """Return the factor on files of light that have no white of their own, a power of 2."""
        brightest = 0.0
        for path, kind in self._kinds.items():
            if kind in _LINEAR:
                light = self._read(path).light
                assert light is not None
                brightest = max(brightest, float(np.percentile(light[::3, ::3].max(2), _BRIGHT)))
        if not brightest or _DARK <= brightest <= 1.001:
            return 1.0
        return 2.0 ** -math.ceil(math.log2(brightest))

    def _read(self, path: Path) -> Picture:
        kind = self._kinds[path]
        if kind == "raw":
            return read_raw(path, self._balances.get(self._facts[path].camera))
        if kind == "heif":
            return read_heif(path)
        if kind in ("avif", "webp"):
            return read_by_pillow(path)
        return read_exr(path) if kind == "exr" else read_float_tiff(path)

    def _develop(self, path: Path, target: Path) -> dict[str, Any]:
        picture, kind = self._read(path), self._kinds[path]
        record: dict[str, Any] = {
            "kind": kind,
            "light": picture.light is not None,
            "gain_map": has_gain_map(path),
        }
        if picture.light is None:
            assert picture.codes is not None
            write_png(target, picture.codes, picture.exif, picture.profile)
            return record
        light = picture.light * np.float32(self._scale if kind in _LINEAR else 1.0)
        codes = encode_16(light)
        if picture.alpha is not None:
            alpha = np.rint(picture.alpha * 65535).astype(np.uint16)[..., None]
            codes = np.concatenate([codes, alpha], axis=2)
        write_png(target, codes, picture.exif)
        record |= {
            "saturated": float((light >= 1).any(2).mean()),
            "invalid": picture.invalid,
        }
        if kind in _LINEAR:
            return record | {"scale": self._scale}
        if path not in self._facts:
            return record
        facts = self._facts[path]
        return record | {
            "camera": facts.camera,
            "black": facts.black,
            "white": facts.white,
            "white_balance_of_camera": facts.balance,
            "white_balance": self._balances.get(facts.camera),
            "matrix": facts.matrix,
        }

    def _notes(self, records: Sequence[Mapping[str, Any]]) -> list[str]:
        counts = Counter(NAMES[r["kind"]] for r in records)
        listed = ", ".join(f"{n} {name}" for name, n in counts.most_common())
        out = [f"Developed into the run's cache: {listed}."]
        for camera, balance in self._balances.items():
            taken = [f for f in self._facts.values() if f.camera == camera]
            chosen = np.log2([f.balance for f in taken if f.balance is not None])
            spread = float(np.ptp(chosen - chosen[:, 1:2], axis=0).max())
            out.append(
                f"White balance of {len(taken)} raw photographs ({camera or 'camera unknown'}): "
                f"red {balance[0]:.3f}, blue {balance[2]:.3f} for all, the median of what the "
                f"camera chose, which varied by {spread:.2f} EV."
            )
        without = [f for f in self._facts.values() if f.balance is None]
        if without:
            out.append(
                f"{len(without)} raw photographs record no white balance: LibRaw's for daylight."
            )
        if strange := sum(not f.matrix for f in self._facts.values()):
            out.append(
                f"{strange} raw photographs are of a camera whose colours LibRaw does not know: "
                "they stay in the camera's own primaries."
            )
        if self._scale != 1:
            out.append(
                f"Linear photographs were multiplied by {self._scale:g}, all alike, so that "
                f"{_BRIGHT:g} % of each are below white."
            )
        if maps := sum(r["gain_map"] for r in records):
            out.append(
                f"{maps} of them carry a gain map for bright displays; the photograph itself is "
                "used, the map is not."
            )
        if broken := sum(r.get("invalid", 0) for r in records):
            out.append(
                f"{broken} pixels of linear photographs are no numbers; they count as black."
            )
        return out


def _common_balances(facts: Any) -> dict[str, Balance]:
    """Return one white balance for each camera: the median of what it chose."""
    chosen: dict[str, list[Balance]] = defaultdict(list)
    for one in facts:
        if isinstance(one, RawFacts) and one.balance is not None:
            chosen[one.camera].append(one.balance)
    return {
        camera: tuple(float(x) for x in np.exp(np.median(np.log(balances), axis=0)))  # type: ignore[misc]
        for camera, balances in chosen.items()
    }


def _link(source: Path, target: Path) -> None:
    try:
        target.symlink_to(source)
    except OSError:  # file systems without links
        try:
            os.link(source, target)
        except OSError:
            try:
                shutil.copyfile(source, target)
            except OSError as error:
                raise UserError(
                    f"{source} cannot be copied to {target}: {error.strerror or error}.",
                    fix="make room on that disk, or name another --out",
                ) from None
