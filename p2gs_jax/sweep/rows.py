"""The table of a sweep: columns read from the finished runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.core.clock import whole_run
from p2gs_jax.core.json_text import parse_json
from p2gs_jax.evaluate.alignment import exposure_error
from p2gs_jax.synth.exposures import read_true_exposures

# Name of the column, path in metrics.json, digits.
COLUMNS: tuple[tuple[str, tuple[str, ...], int], ...] = (
    ("gaussians", ("counts", "gaussians"), 0),
    ("steps", ("counts", "steps"), 0),
    ("seconds", (), 0),
    ("train_psnr", ("train", "psnr"), 2),
    ("train_ssim", ("train", "ssim"), 4),
    ("train_lpips", ("train", "lpips"), 4),
    ("test_psnr_averaged", ("test", "averaged", "psnr"), 2),
    ("test_lpips_averaged", ("test", "averaged", "lpips"), 4),
    ("test_psnr_fitted", ("test", "exposure_fitted", "psnr"), 2),
    ("test_psnr_all_fitted", ("test", "photometry_fitted", "psnr"), 2),
    ("reference_psnr_averaged", ("reference", "averaged", "psnr"), 2),
    ("reference_psnr", ("reference", "scale_aligned", "psnr"), 2),
    ("reference_lpips", ("reference", "scale_aligned", "lpips"), 4),
    ("reference_test_psnr", ("reference", "scale_aligned", "test", "psnr"), 2),
    ("reference_test_lpips", ("reference", "scale_aligned", "test", "lpips"), 4),
    ("radiance_stops", ("radiance", "stops_rms"), 3),
    ("ev", (), 4),
    ("ev_power", (), 4),
)


def read_row(run: Path, scene: Path) -> dict[str, Any]:
    """Return the columns that a finished run has, by name.

    Args:
        run: its folder.
        scene: where `truth/exposures.csv` may lie.
    """
    metrics = parse_json((run / "metrics.json").read_text(encoding="utf-8"))
    row: dict[str, Any] = {}
    for name, path, _ in COLUMNS:
        value = metrics
        for key in path:
            value = value.get(key) if isinstance(value, Mapping) else None
        if path and value is not None:
            row[name] = value
    seconds = metrics.get("seconds")
    total = whole_run(seconds) if isinstance(seconds, Mapping) else None
    return row | ({} if total is None else {"seconds": total}) | _exposures(run, scene)


def _exposures(run: Path, scene: Path) -> dict[str, float]:
    """Return errors of the exposures where the scene knows them."""
    truth = read_true_exposures(scene)
    if not truth:
        return {}
    views = parse_json((run / "photometry.json").read_text(encoding="utf-8"))["views"]
    pairs = [(v["exposure"], truth[v["image"]]) for v in views if v["exposure"] is not None]
    if len(pairs) < 2:
        return {}
    error = exposure_error(*np.array(pairs).T)
    return {"ev": error["ev"], "ev_power": error["ev_scale_power"]}


# Explanations of the columns' names.
MEANING = {
    "seconds": "of the whole run, compilation and evaluation included",
    "train_": "training views, each under its own exposure and gamma",
    "test_psnr_averaged": "held-out views under the mean exposure and gamma (as in the paper)",
    "test_psnr_fitted": "held-out views, exposure fitted to each photograph: the one to trust",
    "test_psnr_all_fitted": "likewise, all fitted that varies per view",
    "reference_psnr": "all views against photographs of one exposure, one scale for all",
    "reference_psnr_averaged": "likewise under the mean exposure",
    "reference_test_": "likewise, held-out views only",
    "radiance_stops": "RMS error of the radiance against HDR truth, stops",
    "ev": "RMS error of the exposures against the truth, stops, after one scale",
    "ev_power": "likewise after the best power as well",
}
# Columns of the short table, which fits a terminal: column, heading, digits.
BRIEF = (
    ("seconds", "seconds", 0),
    ("gaussians", "Gaussians", 0),
    ("train_psnr", "training PSNR dB", 2),
    ("test_psnr_fitted", "held-out PSNR dB", 2),
    ("reference_psnr", "reference PSNR dB", 2),
    ("ev", "exposure error EV", 3),
)


def brief(rows: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return headings and cells of the columns that matter most; means over seeds."""
    shown = [(c, h, d) for c, h, d in BRIEF if any(c in row for row in rows)]
    lines = []
    for name in dict.fromkeys(row["name"] for row in rows):
        mine = [row for row in rows if row["name"] == name]
        done = [row for row in mine if row["status"] == "done"]
        cells = [_mean(done, column, digits) for column, _, digits in shown]
        lines.append([str(name), f"{len(done)} of {len(mine)}", *cells])
    return ["configuration", "seeds", *(h for _, h, _ in shown)], lines


def _mean(rows: list[dict[str, Any]], column: str, digits: int) -> str:
    values = [row[column] for row in rows if column in row]
    return f"{np.mean(values):.{digits}f}" if values else "-"


def failures(rows: list[dict[str, Any]]) -> list[str]:
    """Return a line for every run that is not done, with its reason."""
    return [
        f"{row['name']}, seed {row['seed']}: {row['status']}: {row.get('reason', '')}"
        for row in rows
        if row["status"] != "done"
    ]


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """Return a table: a line per configuration, means over its seeds; failures with reasons."""
    names = list(dict.fromkeys(row["name"] for row in rows))
    shown = [(c, d) for c, _, d in COLUMNS if any(c in row for row in rows)]
    lines = [
        "| configuration | seeds | " + " | ".join(c for c, _ in shown) + " |",
        "|---|---:|" + "---:|" * len(shown),
    ]
    for name in names:
        mine = [row for row in rows if row["name"] == name]
        done = [row for row in mine if row["status"] == "done"]
        cells = [_mean(done, column, digits) for column, digits in shown]
        lines.append(f"| {name} | {len(done)} of {len(mine)} | " + " | ".join(cells) + " |")
    meant = [
        f"- `{name}{'*' if name.endswith('_') else ''}`: {text}"
        for name, text in MEANING.items()
        if any(c == name or (name.endswith("_") and c.startswith(name)) for c, _ in shown)
    ]
    if meant:
        lines += ["", *meant]
    bad = failures(rows)
    if bad:
        lines += ["", "Not finished:", "", *(f"- {line}" for line in bad)]
    return "\n".join(lines) + "\n"
