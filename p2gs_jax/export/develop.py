"""Photographs brought to one exposure, in a folder that other trainers read as their scene."""

from __future__ import annotations

import contextlib
import csv
import functools
import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float
from PIL import ExifTags, Image

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import append_jsonl, plain, read_jsonl, remove_begun
from p2gs_jax.core.numerics import LN2, evenly_spaced
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.text import first_few
from p2gs_jax.core.threads import map_in_order
from p2gs_jax.errors import UserError
from p2gs_jax.export.film import Film, Finish, across, common_curve, dithered
from p2gs_jax.export.folders import RGB, is_copied, mask_name, write_photograph
from p2gs_jax.export.poses import Poses, write_if_new
from p2gs_jax.formats.exr import write_exr
from p2gs_jax.formats.frames import shrunk
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.display import mean_parameters
from p2gs_jax.photometry.formation import exposed_at
from p2gs_jax.photometry.parameters import initial_photometry
from p2gs_jax.run.decisions import decide
from p2gs_jax.scene.files import file_fingerprints
from p2gs_jax.scene.pixels.decode import floats, stored
from p2gs_jax.types import Photometry, Scene, View

Depth = Literal["8bit", "16bit", "exr"]
FOLDER = "developed"
# Part of the key of developed photographs: raise it whenever results change.
_VERSION = 2
# Suffixes that photographs keep, the suffix of all others, and the stored value of white: values of
# 8 bits have 8 fractional bits.
_FORMATS: dict[Depth, tuple[tuple[str, ...], str, int]] = {
    "8bit": ((".jpg", ".jpeg", ".jfif", ".png", ".tif", ".tiff", ".bmp"), ".png", 255 * 256),
    "16bit": ((".png",), ".png", 65535),
    "exr": ((".exr",), ".exr", 255 * 256),
}
# The exposure `highlights` keeps this share of the unclipped pixels of each photograph below white.
_BELOW_WHITE = 0.999
# Number of photographs on the sheet, and their longer side, pixels.
_SHOWN, _SMALL = 12, 480
# EXIF tags of exposure time, f-number, sensitivities and APEX values, which describe the original.
_EXPOSURE = (0x829A, 0x829D, 0x8827, 0x8830, 0x8831, 0x8832, 0x8833, 0x9201, 0x9202, 0x9204)
_COMMENT = "linear relative radiance times the common exposure of all photographs"

Picture = Float[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Development:
    """Options of `develop_scene`."""

    depth: Depth = "8bit"  # 8 or 16 bits of display values, or linear radiance
    # Exposure of the result: stops from the geometric mean exposure of the photographs, or the
    # largest that loses no highlight.
    exposure: float | Literal["highlights"] = 0.0
    masks: bool = True  # mask pixels that are clipped or black in a photograph


@dataclass(frozen=True)
class Developed:
    """The results of `develop_scene`."""

    folder: Path
    options: Development
    exposure_ev: float  # common exposure, stops, on the scale of the calibration
    rows: tuple[Mapping[str, Any], ...]  # the rows of `exposures.csv`
    messages: tuple[str, ...]  # sentences for the user
    written: int  # number of photographs that were not there before
    # Returns names and pictures of some photographs before and after, small display values, the
    # darkest exposure first.
    shown: Callable[[], list[tuple[str, Picture, Picture]]]


class _Lab:
    """Photographs and their photometry; those without an exposure have the mean of their camera."""

    def __init__(self, cfg: FitConfig, selection: Selection, views: Sequence[View]):
        s, self.views, self.loss = selection.solution, views, cfg.loss
        self.solved, self.solution = np.isfinite(s.exposure_errors), s
        cameras = np.array([view.camera for view in views])
        names = ("log_exposures", "gammas", "white_balance")
        values = {name: np.array(getattr(s, name), float) for name in names}
        for row in np.flatnonzero(~self.solved) if self.solved.any() else ():
            alike = self.solved & (cameras == cameras[row])
            for value in values.values():
                value[row] = value[alike if alike.any() else self.solved].mean(0)
        resolved = decide(cfg, selection, None).resolve(cfg)
        self.cfg = resolved.photometry
        found = initial_photometry(replace(s, **values), cameras.tolist(), resolved)
        self.photometry: Photometry = jax.tree.map(np.asarray, found)
        self.mean = mean_parameters(self.photometry)

    def film(self, row: int, top: int) -> Film:
        capture = self.photometry.capture(row)
        return Film.of(self.views[row], capture, top, self.cfg, self.loss.saturation)

    def read(self, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, Film]:
        """Return stored values, the pixels that count, alpha, and the film of a photograph."""
        pixels, valid, opacity = stored(self.views[row])
        return pixels, valid, opacity, self.film(row, int(np.iinfo(pixels.dtype).max))

    def log_exposure(self, asked: float | Literal["highlights"], reporter: Reporter) -> float:
        """Return the common exposure, in natural logarithms.

        For `highlights`, photographs that can hold the brightest radiance are measured first, until
        no other can hold more.
        """
        if asked != "highlights":
            return float(np.log(self.mean.exposure_geometric)) + LN2 * asked
        most = np.array([self.film(row, 255).most() for row in range(len(self.views))])
        found = -np.inf
        for count, row in enumerate(np.argsort(-most).tolist()):
            if most[row] <= found:
                break
            reporter.stage("Finding the brightest highlight", count, len(most))
            pixels, valid, _, film = self.read(row)
            used = valid & (across(np.maximum, pixels) < film.white)
            light = film.developed(pixels, np.exp).max(-1)[used]
            if used.any():
                found = max(found, float(np.log(np.quantile(light, _BELOW_WHITE))))
        white = np.log(exposed_at(self.loss.saturation, self.mean.gamma, self.cfg))
        return float(white) - (found if np.isfinite(found) else 0.0)

    def notes(self) -> list[str]:
        """Return what users must know about exposures that were assumed."""
        names = [self.views[row].name for row in np.flatnonzero(~self.solved).tolist()]
        note = (
            f"The mean exposure of the camera was used for {first_few(names)} and may be wrong: "
            "too few points are visible in other photographs as well."
        )
        return [note] if names else []


def places_of(poses: Poses, scene: Scene, out: Path, options: Development) -> dict[str, str]:
    """Return where the photographs go, by view; UserError: one would replace an original."""
    places, folder = poses.places(*_FORMATS[options.depth][:2]), (out / FOLDER).resolve()
    originals = {view.image_path.resolve() for view in scene.views}
    targets = {(folder / place).resolve() for place in places.values()}
    root = scene.root if scene.root.is_dir() else scene.root.parent
    holding = {root.resolve(), *(path.parent for path in originals)}
    if originals & targets or holding & {out.resolve(), folder}:
        why = f"--out {out} would write developed photographs over the originals in {root}, or "
        why += "among them."
        raise UserError(why, fix="name another folder with --out")
    return places


def develop_scene(
    scene: Scene,
    poses: Poses,
    out: Path,
    cfg: FitConfig,
    selection: Selection,
    options: Development,
    reporter: Reporter,
) -> Developed:
    """Write the scene `developed` into the folder of a calibration; return what was done.

    Photographs that are there already, from the same files, parameters and options, stay. Raises
    UserError: a photograph cannot be read, or a file would replace an original.
    """
    folder, log = out / FOLDER, out / "cache" / "developed.jsonl"
    views, places = scene.training_views, places_of(poses, scene, out, options)
    lab = _Lab(cfg, selection, views)
    log_exposure = lab.log_exposure(options.exposure, reporter)
    curve = (log_exposure, lab.mean.gamma, lab.cfg)
    codes = common_curve(*curve, _FORMATS[options.depth][2])
    key = _key(lab, log_exposure, options, places)
    log.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(exist_ok=True)
    remove_begun(folder, "")
    former = read_jsonl(log)
    same = [record for record in former if record["key"] == key and _is_there(folder, record)]
    done = {record["view"]: record for record in same}
    for place in {record["place"] for record in former} - {record["place"] for record in same}:
        for path in (folder / place, folder / _mask_of(place)):
            path.unlink(missing_ok=True)
    write_if_new(log, "".join(json.dumps(record) + "\n" for record in done.values()).encode())
    todo = [row for row, view in enumerate(views) if view.name not in done]

    def one(row: int) -> dict[str, Any]:
        name = views[row].name
        facts = _develop(lab, row, codes, log_exposure, folder, places[name], options)
        return {"view": name, "place": places[name], "key": key, **facts}

    for count, record in enumerate(map_in_order(one, todo), 1):
        append_jsonl(log, record)
        done[record["view"]] = record
        reporter.stage("Developing photographs", count, len(todo))
    records = [done[view.name] for view in views]
    rows = _rows(lab, log_exposure / LN2, records)
    poses.write(folder, places, _complete_masks(folder, records))
    write_if_new(folder / "exposures.csv", _table(rows))
    messages = (*lab.notes(), *poses.notes(places))
    shown = functools.partial(_shown, lab, curve)
    ev = round(log_exposure / LN2, 6) + 0.0
    return Developed(folder, options, ev, rows, messages, len(todo), shown)


def _is_there(folder: Path, record: Mapping[str, Any]) -> bool:
    masked = not record["masked"] or (folder / _mask_of(record["place"])).is_file()
    return masked and (folder / record["place"]).is_file()


def _develop(
    lab: _Lab,
    row: int,
    codes: Finish,
    log_exposure: float,
    folder: Path,
    place: str,
    options: Development,
) -> dict[str, Any]:
    """Write a photograph and, where pixels are masked, its mask; return the facts of its record."""
    view, target = lab.views[row], folder / place
    pixels, valid, opacity, film = lab.read(row)
    largest = across(np.maximum, pixels)
    clipped, black = largest >= film.white, largest <= lab.loss.black * len(film.logs)
    if options.masks:
        valid = valid & ~clipped & ~black
    if options.depth == "exr":
        light = film.developed(pixels, lambda logs: np.exp(logs + np.float32(log_exposure)))
        alpha = None if opacity is None else floats(opacity)
        light = light if alpha is None else light * alpha[..., None]
        write_exr(target, light, alpha=alpha, comments=_COMMENT)
    elif options.depth == "8bit" and film.changes_nothing(codes) and is_copied(view, target):
        write_if_new(target, view.image_path.read_bytes())
    else:
        found = film.developed(pixels, codes)
        found = dithered(found, view.name) if options.depth == "8bit" else found
        if opacity is not None:
            alpha = np.rint(floats(opacity) * np.iinfo(found.dtype).max).astype(found.dtype)
            found = np.concatenate([found, alpha[..., None]], 2)
        write_photograph(target, found, _exif(view))
    if not valid.all():
        _write_mask(folder / _mask_of(place), valid)
    shares = {"masked": ~valid, "clipped": clipped, "black": black}
    return {"size": valid.shape, **{name: float(each.mean()) for name, each in shares.items()}}


def _exif(view: View) -> Image.Exif | None:
    """Return the EXIF of a photograph without the tags of the original's brightness."""
    exif = None
    with contextlib.suppress(Exception), Image.open(view.image_path) as image:  # malformed EXIF
        exif = image.getexif()
        shot = exif.get_ifd(ExifTags.IFD.Exif)
        for tag in _EXPOSURE:
            shot.pop(tag, None)
    return exif


def _mask_of(place: str) -> str:
    return mask_name(place.removeprefix("images/"))


def _write_mask(path: Path, valid: Bool[np.ndarray, "h w"]) -> None:
    """Write a mask; 255 marks pixels that count."""
    done, data = cv2.imencode(".png", valid.astype(np.uint8) * 255)
    assert done
    write_if_new(path, data.tobytes())


def _complete_masks(folder: Path, records: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the place of each mask by view: nerfstudio needs one for all photographs or none."""
    if not any(record["masked"] for record in records):
        return {}
    for record in records:
        if not record["masked"]:
            _write_mask(folder / _mask_of(record["place"]), np.ones(record["size"], bool))
    return {record["view"]: _mask_of(record["place"]) for record in records}


def _key(lab: _Lab, log_exposure: float, options: Development, places: Mapping[str, str]) -> str:
    """Return a hash of everything that the developed photographs depend on."""
    paths = [p for view in lab.views for p in (view.image_path, view.mask_path) if p is not None]
    p = lab.photometry
    parameters = [p.raw_exposures, p.raw_gammas, p.raw_white_balance]
    settings = [asdict(lab.cfg), asdict(lab.loss), asdict(options), dict(places)]
    lenses = [(view.K, None if (d := view.distortion) is None else asdict(d)) for view in lab.views]
    whole = [_VERSION, file_fingerprints(paths), log_exposure, parameters, settings, lenses]
    # The last digits of a solution may differ between processors.
    text = json.dumps(plain(whole))
    rounded = json.loads(text, parse_float=lambda number: round(float(number), 5) + 0.0)
    return hashlib.sha256(json.dumps(rounded).encode()).hexdigest()


def _rows(
    lab: _Lab, common: float, records: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, Any], ...]:
    """Return the rows of `exposures.csv`; `ev` is the exposure of the developed photographs."""
    out, errors, balance = [], lab.solution.exposure_errors_ev, lab.photometry.white_balance
    for row, (view, record) in enumerate(zip(lab.views, records, strict=True)):
        ev, known = float(lab.photometry.log_exposures[row]) / LN2, bool(lab.solved[row])
        factors = () if balance is None else np.exp(balance[row]).tolist()
        values = {
            "image": record["place"].removeprefix("images/"),
            "camera": view.camera,
            "ev": common,
            "original_ev": ev if known else None,
            "original_ev_error": float(errors[row]) if known else None,
            "gain_ev": common - ev,
            "gamma": float(lab.photometry.gammas[row]),
            **dict(zip(RGB, factors, strict=False)),
        }
        out.append(values | {name: record[name] for name in ("clipped", "black")})
    return tuple(out)


def _table(rows: Sequence[Mapping[str, Any]]) -> bytes:
    out = io.StringIO()
    table = csv.DictWriter(out, list(rows[0]), lineterminator="\n")
    table.writeheader()
    for row in rows:
        table.writerow({k: f"{v:.6f}" if isinstance(v, float) else v for k, v in row.items()})
    return out.getvalue().encode()


def _shown(lab: _Lab, curve: tuple[float, float, Any]) -> list[tuple[str, Picture, Picture]]:
    out, codes = [], common_curve(*curve, most=65535)
    order = np.argsort(lab.photometry.log_exposures, kind="stable")
    for row in order[evenly_spaced(len(order), _SHOWN)]:
        pixels, _, _, film = lab.read(row)
        small = np.ascontiguousarray(shrunk(pixels, _SMALL))
        out.append((lab.views[row].name, floats(small), floats(film.developed(small, codes))))
    return out
