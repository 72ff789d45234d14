"""Several runs in one table and on one page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from p2gs_jax.errors import UserError
from p2gs_jax.report import run_summary
from p2gs_jax.report.run_files import RunFiles, part_at, read_run
from p2gs_jax.report.run_sections import flat, option_text
from p2gs_jax.report.scene_measurements import SceneMeasurements
from p2gs_jax.report.view_comparisons import read_png
from p2gs_jax.synth.exposures import read_true_exposures

Better = Literal["high", "low"] | None


@dataclass(frozen=True)
class TableRow:
    """One line of the table.

    Attributes:
        name: with its unit.
        cells: text for every run; empty where it has none.
        best: runs that are best in it.
    """

    name: str
    cells: tuple[str, ...]
    best: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Comparison:
    """A comparison of several runs.

    Attributes:
        runs: in the order given.
        labels: a short name for each, all different.
        remarks: sentences on what cannot be compared.
        same_scene: whether scores can be compared.
        scores: the table.
        options: options that differ.
        exposures: label of each later run, and exposures of the first and of it in stops, of the
            views that both have, means removed.
    """

    runs: tuple[RunFiles, ...]
    labels: tuple[str, ...]
    remarks: tuple[str, ...]
    same_scene: bool
    scores: tuple[TableRow, ...]
    options: tuple[TableRow, ...]
    exposures: tuple[tuple[str, np.ndarray, np.ndarray], ...]


# Name, path in metrics.json, digits, which is better.
NUMBERS: tuple[tuple[str, tuple[str, ...], int, Better], ...] = (
    ("Gaussians", ("counts", "gaussians"), 0, None),
    ("steps", ("counts", "steps"), 0, None),
    ("training PSNR, dB", ("train", "psnr"), 2, "high"),
    ("training SSIM", ("train", "ssim"), 4, "high"),
    ("training LPIPS", ("train", "lpips"), 4, "low"),
    ("held-out PSNR, mean exposure, dB", ("test", "averaged", "psnr"), 2, "high"),
    ("held-out PSNR, fitted exposure, dB", ("test", "exposure_fitted", "psnr"), 2, "high"),
    ("held-out SSIM, fitted exposure", ("test", "exposure_fitted", "ssim"), 4, "high"),
    ("held-out LPIPS, fitted exposure", ("test", "exposure_fitted", "lpips"), 4, "low"),
    (
        "held-out PSNR, all fitted that varies per view, dB",
        ("test", "photometry_fitted", "psnr"),
        2,
        "high",
    ),
    ("reference PSNR, one scale, dB", ("reference", "scale_aligned", "psnr"), 2, "high"),
    (
        "reference PSNR, held out, one scale, dB",
        ("reference", "scale_aligned", "test", "psnr"),
        2,
        "high",
    ),
    ("radiance error, median, stops", ("radiance", "stops_median"), 3, "low"),
    ("radiance error, RMS, stops", ("radiance", "stops_rms"), 3, "low"),
    ("HDR inconsistency (HIS) of the renders", ("consistency", "per_view", "his"), 3, None),
    ("HDR inconsistency (HIS) of the photographs", ("consistency", "photographs", "his"), 3, None),
)


def compare_runs(folders: Sequence[str | Path]) -> Comparison:
    """Read and compare runs.

    Args:
        folders: run folders; exposures are drawn over those of the first.

    Raises:
        UserError: there are fewer than two, or one is no run folder.
    """
    if len(folders) < 2:
        raise UserError(
            f"there {'is one run' if folders else 'are no runs'} to compare.",
            fix="name two run folders or more: p2gs-jax compare RUN_A RUN_B",
        )
    runs = tuple(read_run(Path(folder)) for folder in folders)
    labels = tuple(_labels([run.folder for run in runs]))
    same = all(_same_scene(runs[0], run) for run in runs[1:])
    remarks = [
        f"{label}: {sentence}"
        for label, run in zip(labels, runs, strict=True)
        for sentence in run.missing
    ]
    if not same:
        names = ", ".join(dict.fromkeys(str(run.scene) for run in runs))
        remarks.insert(
            0,
            f"The runs are of different scenes ({names}): their scores do not compare, and "
            "exposures and views are not held against each other.",
        )
    return Comparison(
        runs,
        labels,
        tuple(remarks),
        same,
        tuple(_scores(runs, same)),
        tuple(_options(runs)),
        tuple(_exposures(runs, labels)) if same else (),
    )


def _labels(folders: list[Path]) -> list[str]:
    """Return the last parts of paths, as many as it takes to tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(p[-depth:]).replace("//", "/") for p in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{p[-1]} ({i + 1})" for i, p in enumerate(parts)]


def _same_scene(first: RunFiles, other: RunFiles) -> bool:
    """Return whether two runs are of one scene: one folder, or the same held-out photograph."""
    if first.scene.resolve() == other.scene.resolve():
        return True
    there = {h.name: h.photograph for h in other.held_out}
    for mine in first.held_out:
        if mine.name in there:
            try:
                a, b = read_png(mine.photograph), read_png(there[mine.name])
            except UserError:
                continue
            return a.shape == b.shape and np.array_equal(a, b)
    return False


def _scores(runs: Sequence[RunFiles], same: bool) -> list[TableRow]:
    def line(name: str, say: Callable[[RunFiles], str]) -> TableRow:
        return TableRow(name, tuple(say(run) for run in runs))

    rows = [
        line("preset", lambda run: run.preset),
        line("model", _model),
        line("tone curve", _curve),
        line("training views", lambda run: str(len(run.train) or "")),
    ]
    for name, path, digits, better in NUMBERS:
        values = [run.number(*path) for run in runs]
        if any(v is not None for v in values):
            rows.append(_row(name, values, digits, better if same else None))
    seconds = [run_summary.seconds_of(run) for run in runs]
    if any(s is not None for s in seconds):
        rows.insert(6, _row("seconds, whole run", seconds, 0, None))
    errors = [_true_error(run) for run in runs]
    if any(e is not None for e in errors):
        rows.append(_row("exposure error, RMS, stops", errors, 4, "low" if same else None))
    return rows


def _row(name: str, values: Sequence[float | None], digits: int, better: Better) -> TableRow:
    cells = tuple("" if v is None else f"{v:,.{digits}f}" for v in values)
    known = [v for v in values if v is not None]
    if better is None or len(known) < 2 or len(set(filter(None, cells))) < 2:
        return TableRow(name, cells)
    best = f"{(max if better == 'high' else min)(known):,.{digits}f}"
    return TableRow(name, cells, frozenset(i for i, cell in enumerate(cells) if cell == best))


def _model(run: RunFiles) -> str:
    if run.photometry is None:
        return ""
    model = run.photometry["model"]
    return run_summary.DESCRIPTIONS.get(model, model)


def _curve(run: RunFiles) -> str:
    return "" if run.photometry is None else str(run.photometry["curve"].get("name", ""))


def _true_error(run: RunFiles) -> float | None:
    try:
        truth = read_true_exposures(run.scene)
    except (OSError, KeyError, ValueError):
        return None
    error = run_summary.true_error(run, SceneMeasurements(true_exposures=truth))
    return None if error is None else error["ev"]


def _options(runs: Sequence[RunFiles]) -> list[TableRow]:
    every = [flat(run.options) for run in runs]
    names = list(dict.fromkeys(name for options in every for name in options))
    rows = []
    for name in names:
        cells = tuple(option_text(options[name]) if name in options else "" for options in every)
        if len(set(cells)) > 1:
            rows.append(TableRow(name, cells))
    return rows


def _exposures(runs: Sequence[RunFiles], labels: Sequence[str]):
    first = _stops(runs[0])
    for label, run in zip(labels[1:], runs[1:], strict=True):
        other = _stops(run)
        common = [name for name in first if name in other]
        if len(common) >= 2:
            x, y = (np.array([values[n] for n in common]) for values in (first, other))
            yield label, x - x.mean(), y - y.mean()


def _stops(run: RunFiles) -> dict[str, float]:
    return {v["image"]: v["exposure_ev"] for v in run.train if v["exposure_ev"] is not None}


def common_held_out(runs: Sequence[RunFiles]) -> list[str]:
    """Return names of held-out views that every run shows."""
    names = [{h.name for h in run.held_out} for run in runs]
    return sorted(set.intersection(*names)) if names else []


def psnr_of(run: RunFiles, name: str) -> str:
    """Return the score of a held-out view in words; empty where there is none."""
    scores = part_at(run.metrics, "test", "exposure_fitted", "per_view", name)
    value = scores.get("psnr")
    return f"{value:.1f} dB" if isinstance(value, int | float) else ""


def to_markdown(found: Comparison) -> str:
    """Return the tables as Markdown, the best scores bold."""
    lines = [f"{remark}\n" for remark in found.remarks]
    lines += _markdown_table("", found.labels, found.scores)
    if found.options:
        lines += ["", "Options that differ:", ""]
        lines += _markdown_table("option", found.labels, found.options)
    for label, x, y in found.exposures:
        lines += [
            "",
            f"Exposures of {label} and {found.labels[0]} differ by {apart(x, y):.3f} "
            f"stops (RMS over {len(x)} views, means removed).",
        ]
    return "\n".join(lines) + "\n"


def apart(x: np.ndarray, y: np.ndarray) -> float:
    """Return the RMS difference."""
    return float(np.sqrt(np.mean((x - y) ** 2)))


def _markdown_table(head: str, labels: Sequence[str], rows: Sequence[TableRow]) -> list[str]:
    def plain(text: str) -> str:
        return text.replace("|", "\\|")

    lines = [f"| {head} | {' | '.join(map(plain, labels))} |", "|---|" + "---:|" * len(labels)]
    for row in rows:
        cells = [
            f"**{plain(c)}**" if i in row.best else plain(c) or "-" for i, c in enumerate(row.cells)
        ]
        lines.append(f"| {plain(row.name)} | {' | '.join(cells)} |")
    return lines
