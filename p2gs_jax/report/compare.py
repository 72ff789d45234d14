"""Scores and options of several runs side by side, also as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p2gs_jax.core.clock import whole_run
from p2gs_jax.core.text import escaped, markdown_table, value_at
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.alignment import true_error
from p2gs_jax.evaluation.renders_of_others import read_display
from p2gs_jax.presets import flat
from p2gs_jax.report.findings import DESCRIPTIONS
from p2gs_jax.report.run_files import RunFiles, read_run
from p2gs_jax.report.run_sections import option_text


class TableRow(NamedTuple):
    """A row: its name with unit, a text (or "") for each run, and the indices of the best runs."""

    name: str
    cells: tuple[str, ...]
    best: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Comparison:
    """Several runs side by side, in the order of the command, each with a short unique label.

    `remarks` are sentences on missing files and different scenes. Scores compare only if the scene
    is the same. `options` holds the options that differ. `apart` has an entry for each later run
    with at least 2 views of the first: its label, the RMS difference of their exposures after
    removing the means (stops), and the number of common views.
    """

    labels: tuple[str, ...]
    remarks: tuple[str, ...]
    same_scene: bool
    scores: tuple[TableRow, ...]
    options: tuple[TableRow, ...]
    apart: tuple[tuple[str, float, int], ...]

    @property
    def tables(self) -> dict[str, tuple[TableRow, ...]]:
        """The tables that have rows, by their titles."""
        every = {"Scores": self.scores, "Options that differ": self.options}
        return {title: rows for title, rows in every.items() if rows}

    @property
    def sentences(self) -> list[str]:
        """Sentences on the exposures of the later runs."""
        return [
            f"The exposures of {label} and {self.labels[0]} differ by {rms:.3f} stops (RMS over "
            f"{count} views, means removed)."
            for label, rms, count in self.apart
        ]


# Paths of the scores in `metrics.json`; their last parts are the keys of `DIGITS` and `BETTER`.
NUMBERS: dict[str, tuple[str, ...]] = {
    "Gaussians": ("counts", "gaussians"),
    "steps": ("counts", "steps"),
    "training PSNR, dB": ("train", "psnr"),
    "training SSIM": ("train", "ssim"),
    "training LPIPS": ("train", "lpips"),
    "held-out PSNR, mean exposure, dB": ("test", "averaged", "psnr"),
    "held-out PSNR, fitted exposure, dB": ("test", "exposure_fitted", "psnr"),
    "held-out SSIM, fitted exposure": ("test", "exposure_fitted", "ssim"),
    "held-out LPIPS, fitted exposure": ("test", "exposure_fitted", "lpips"),
    "held-out PSNR, fitted photometry, dB": ("test", "photometry_fitted", "psnr"),
    "reference PSNR, one scale, dB": ("reference", "scale_aligned", "psnr"),
    "held-out reference PSNR, one scale, dB": ("reference", "scale_aligned", "test", "psnr"),
    "radiance error, median, stops": ("radiance", "stops_median"),
    "radiance error, RMS, stops": ("radiance", "stops_rms"),
    "HDR inconsistency (HIS) of the renders": ("consistency", "per_view", "his"),
    "HDR inconsistency (HIS) of the photographs": ("consistency", "photographs", "his"),
}
DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4, "stops_median": 3, "stops_rms": 3, "his": 3, "ev": 4}
BETTER = {"psnr": max, "ssim": max}
BETTER |= dict.fromkeys(("lpips", "stops_median", "stops_rms", "ev"), min)


def compare_runs(folders: Sequence[str | Path]) -> Comparison:
    """Read and compare runs; a UserError reports fewer than two runs, or a folder without a run."""
    if len(folders) < 2:
        fix = "name at least two run folders: p2gs-jax compare RUN_A RUN_B"
        raise UserError(f"there {'is one run' if folders else 'are no runs'} to compare.", fix=fix)
    runs = tuple(read_run(Path(folder)) for folder in folders)
    labels = tuple(_labels([run.folder for run in runs]))
    same = all(_same_scene(runs[0], run) for run in runs[1:])
    remarks = [f"{n}: {text}" for n, run in zip(labels, runs, strict=True) for text in run.missing]
    if not same:
        names = ", ".join(dict.fromkeys(str(run.scene) for run in runs))
        remark = (
            f"The runs are of different scenes ({names}). Their scores are not comparable, and "
            "their exposures are not compared."
        )
        remarks.insert(0, remark)
    apart = tuple(_apart(runs, labels)) if same else ()
    scores, options = tuple(_scores(runs, same)), tuple(_options(runs))
    return Comparison(labels, tuple(remarks), same, scores, options, apart)


def _labels(folders: list[Path]) -> list[str]:
    """Return the shortest distinct path ends of equal depth; equal paths get numbers."""
    parts = [folder.resolve().parts for folder in folders]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(p[-depth:]).replace("//", "/") for p in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{p[-1]} ({i + 1})" for i, p in enumerate(parts)]


def _same_scene(first: RunFiles, other: RunFiles) -> bool:
    """Return whether two runs share folder and drive, or have the same held-out photograph."""
    if first.scene.resolve() == other.scene.resolve():
        drives = [value_at(run.options, ("data", "drive")) for run in (first, other)]
        return drives[0] == drives[1]
    others = {h.name: h.photograph for h in other.held_out}
    for view in first.held_out:
        if view.name in others:
            try:
                a, b = read_display(view.photograph), read_display(others[view.name])
            except UserError:
                continue
            return a.shape == b.shape and np.array_equal(a, b)
    return False


def _scores(runs: Sequence[RunFiles], same: bool) -> list[TableRow]:
    def numbers(name: str, values: Sequence[float | None], key: str) -> list[TableRow]:
        """Return one row, or no row if no run has the number."""
        known = [v for v in values if v is not None]
        form = f",.{DIGITS.get(key, 0)}f"
        cells = tuple("" if v is None else format(v, form) for v in values)
        best = frozenset[int]()
        if same and key in BETTER and len(set(filter(None, cells))) > 1:
            goal = format(BETTER[key](known), form)
            best = frozenset(i for i, cell in enumerate(cells) if cell == goal)
        return [TableRow(name, cells, best)] if known else []

    models = [run.photometry["model"] if run.photometry else "" for run in runs]
    curves = [run.photometry["curve"].get("name", "") if run.photometry else "" for run in runs]
    rows = [
        TableRow("preset", tuple(run.preset for run in runs)),
        TableRow("model", tuple(DESCRIPTIONS.get(model, model) for model in models)),
        TableRow("tone curve", tuple(map(str, curves))),
        TableRow("training views", tuple(str(len(run.train) or "") for run in runs)),
        *numbers("seconds, whole run", [whole_run(run.part("seconds")) for run in runs], "seconds"),
    ]
    for name, path in NUMBERS.items():
        rows += numbers(name, [run.number(*path) for run in runs], path[-1])
    found = (true_error(run.scene, run.train) for run in runs)
    errors = [None if error is None else error["ev"] for error in found]
    return rows + numbers("exposure error, RMS, stops", errors, "ev")


def _options(runs: Sequence[RunFiles]) -> list[TableRow]:
    texts = [{n: option_text(value) for n, value in flat(run.options).items()} for run in runs]
    names = dict.fromkeys(name for options in texts for name in options)
    rows = [TableRow(n, tuple(options.get(n, "") for options in texts)) for n in names]
    return [r for r in rows if len(set(r.cells)) > 1]


def _apart(runs: Sequence[RunFiles], labels: Sequence[str]) -> Iterator[tuple[str, float, int]]:
    first, *others = (
        {v["image"]: v["exposure_ev"] for v in run.train if v["exposure_ev"] is not None}
        for run in runs
    )
    for label, other in zip(labels[1:], others, strict=True):
        common = [name for name in first if name in other]
        if len(common) >= 2:
            yield label, float(np.std([first[n] - other[n] for n in common])), len(common)


def to_markdown(found: Comparison) -> str:
    """Return a comparison as Markdown, with a star behind the best scores."""
    parts = [escaped(remark) for remark in found.remarks]
    for title, rows in found.tables.items():
        cells = [[r.name, *starred(r)] for r in rows]
        parts += [f"{title}:", markdown_table(["", *found.labels], cells)]
    return "\n\n".join([*parts, *map(escaped, found.sentences)]) + "\n"


def starred(row: TableRow) -> list[str]:
    """Return the cells of a row: best ones with a star behind, empty ones as -."""
    return [f"{c} *" if i in row.best else c or "-" for i, c in enumerate(row.cells)]
