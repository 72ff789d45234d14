"""The files of a run folder, read without its scene; missing files are listed, not fatal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.core.text import parse_json, stems, value_at
from p2gs_jax.errors import UserError
from p2gs_jax.presets import from_dict
from p2gs_jax.run.folder import find
from p2gs_jax.run.photometry_files import PhotometryFile, ViewPhotometry, read_photometry


class HeldOutFiles(NamedTuple):
    """The files of a held-out view: its photograph, and the render at the fitted exposure.

    The name is as in `metrics.json`, or without suffix if that file does not contain the view.
    """

    name: str
    photograph: Path
    render: Path


@dataclass(frozen=True)
class RunFiles:
    """A run folder and the contents of its files; missing contents are empty or None.

    `scene` is the folder of the scene, which may no longer exist; `scene_argument` is the argument
    of `read_run`. `options` are nested values of `config.json`; `cfg` is made from them, or None if
    this version cannot read them. The log has the lines that hold a step. `missing` has a sentence
    on each file that is missing or cannot be read; `broken` names the unreadable ones.
    """

    folder: Path
    scene: Path
    scene_argument: Path | None
    options: dict[str, Any]
    cfg: FitConfig | None
    metrics: dict[str, Any]
    photometry: PhotometryFile | None
    log: list[dict[str, Any]]
    held_out: tuple[HeldOutFiles, ...]
    missing: tuple[str, ...]
    broken: tuple[str, ...]

    @property
    def preset(self) -> str:
        """The preset on which the options are based."""
        return str(self.options.get("preset", "unknown"))

    @property
    def views(self) -> list[ViewPhotometry]:
        """Views of `photometry.json`."""
        return [] if self.photometry is None else self.photometry["views"]

    @property
    def train(self) -> list[ViewPhotometry]:
        """Training views."""
        return [v for v in self.views if v["split"] == "train"]

    @property
    def cameras(self) -> list[str]:
        """The physical cameras in the order of their first views."""
        return list(dict.fromkeys(v["camera"] for v in self.views))

    def number(self, *path: str) -> float | None:
        """Return a number of `metrics.json`, or None if it is missing."""
        return number_at(self.metrics, *path)

    def part(self, *path: str) -> dict[str, Any]:
        """Return a part of `metrics.json`; empty if it is missing or has no parts."""
        return part_at(self.metrics, *path)

    def option(self, *path: str) -> Any:
        """Return a value of the configuration, or None if it is missing."""
        return part_at(self.options, *path[:-1]).get(path[-1])


def part_at(values: Any, *path: str) -> dict[str, Any]:
    """Return the mapping at a path of nested mappings, or an empty one."""
    found = value_at(values, path)
    return dict(found) if isinstance(found, Mapping) else {}


def number_at(values: Any, *path: str) -> float | None:
    """Return the number at a path of nested mappings, or None."""
    found = value_at(values, path)
    known = isinstance(found, int | float) and not isinstance(found, bool)
    return float(found) if known else None


def read_run(folder: Path, scene: Path | None = None) -> RunFiles:
    """Read all files of a run folder; UserError: the folder has no run, or `scene` is missing.

    `scene` is the current folder of the scene (None: the folder that the fit read).
    """
    path = folder / "config.json"
    if not path.is_file():
        fix = "name the folder that was given to `p2gs-jax fit --out`"
        raise UserError(f"{folder} is not a run folder: {path.name} is missing.", fix=fix)
    if scene is not None and not scene.exists():
        fix = "name the folder of the run's scene with --scene"
        raise UserError(f"{scene} does not exist.", fix=fix)
    missing: list[str] = []
    saved = _read_object(path, "the configuration", missing)
    options, cfg, photometry = part_at(saved, "fit"), None, None
    try:
        cfg = from_dict(options) if options else None
    except (TypeError, ValueError) as error:
        missing.append(f"config.json was written by another version of this program ({error}).")
    metrics = _read_object(folder / "metrics.json", "the scores", missing)
    try:
        photometry = read_photometry(folder / "photometry.json")
    except UserError as error:
        exists = (folder / "photometry.json").exists()
        reason = error.message if exists else "photometry.json is missing."
        missing.append(f"The exposures cannot be displayed: {reason}")
    log = _read_log(folder / "log.jsonl", missing)
    names = [] if photometry is None else [v["image"] for v in photometry["views"]]
    read = {path.name: saved, "metrics.json": metrics, "log.jsonl": log}
    read["photometry.json"] = photometry
    return RunFiles(
        folder,
        scene or find(saved, "scene", folder) or Path(),
        scene,
        options,
        cfg,
        metrics,
        photometry,
        log,
        _find_held_out(folder / "renders", names),
        tuple(missing),
        tuple(n for n, found in read.items() if not found and (folder / n).exists()),
    )


def _read_log(path: Path, missing: list[str]) -> list[dict[str, Any]]:
    """Return the lines of the log that hold a step; if there are none, `missing` gets a reason."""
    try:
        records = read_jsonl(path)
    except (UserError, OSError) as error:
        missing.append(f"The training curves cannot be displayed: {error}")
        return []
    kept = [r for r in records if isinstance(r, dict) and number_at(r, "step") is not None]
    if not kept:
        missing.append("The training curves cannot be displayed: log.jsonl is missing or empty.")
    return kept


def _find_held_out(folder: Path, names: list[str]) -> tuple[HeldOutFiles, ...]:
    """Return the held-out views that `fit` wrote into `renders/`; `names` has all views."""
    whole = dict(zip(stems(names), names, strict=True))
    out = []
    for render in sorted(folder.rglob("*.render.png")):
        stem = render.name.removesuffix(".render.png")
        photograph = render.with_name(f"{stem}.photograph.png")
        short = (render.parent.relative_to(folder) / stem).as_posix()
        # Files that `p2gs-jax render` wrote into renders/all are not held-out views.
        if photograph.is_file() and (short in whole or not whole):
            out.append(HeldOutFiles(whole.get(short, short), photograph, render))
    return tuple(out)


def _read_object(path: Path, content: str, missing: list[str]) -> dict[str, Any]:
    """Return the JSON object `content` of a file; if there is none, `missing` gets a sentence."""
    effect = f"{content} cannot be displayed"
    try:
        value = parse_json(path.read_text(encoding="utf-8"))
        problem = f"{path.name} does not contain a JSON object: {effect}."
    except FileNotFoundError:
        value, problem = None, f"{path.name} is missing: {effect}. The run is not finished."
    except (OSError, ValueError) as error:
        value, problem = None, f"{path.name} cannot be read: {effect} ({error})."
    if isinstance(value, dict):
        return value
    missing.append(problem)
    return {}
