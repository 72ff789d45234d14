"""The tables and sentences that commands print as their results, on stdout."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import HEAVY_HEAD, SIMPLE
from rich.table import Table
from rich.text import Text

from p2gs_jax.cli.shared import INSTALL_VIEWER, has_viewer
from p2gs_jax.core.clock import SUMS, whole_run
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.progress import PlainConsole
from p2gs_jax.core.text import count_of
from p2gs_jax.evaluation.scores import PROTOCOLS
from p2gs_jax.photometry.formation import corner
from p2gs_jax.photometry.solution import WEAK_GAMMA, PhotometricSolution
from p2gs_jax.pipeline.calibrate import Calibration
from p2gs_jax.report.findings import duration
from p2gs_jax.report.run_files import part_at

# Columns of words; all others hold numbers.
WORDS = ("views", "view", "camera", "protocol", "program", "lens", "configuration", "")
# Short fits, or too few photographs, have lower scores, dB (nine photographs: 15.8 dB).
LOW_DB = 20.0
VERDICT_ON_LOW = (
    "This is low: fit for longer (--budget), or read docs/quickstart.md, When something goes wrong."
)


def make_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str | None = None,
    *,
    plain: bool = False,
) -> Table:
    """Return a table; `plain` draws few lines."""
    out = Table(title=title, title_justify="left", box=SIMPLE if plain else HEAVY_HEAD)
    for name in columns:
        words = name in WORDS
        justify = "left" if words else "right"
        out.add_column(Text(name), justify=justify, no_wrap=not words, overflow="fold")
    for row in rows:
        out.add_row(*map(Text, row))
    return out


def scores(part: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return PSNR, SSIM and LPIPS of a part of metrics.json as text."""
    lpips = f"{part['lpips']:.4f}" if "lpips" in part else "n/a"
    return f"{part['psnr']:.2f}", f"{part['ssim']:.4f}", lpips


def print_headline(metrics: dict[str, Any], run: Path) -> None:
    """Print the main score of a fit, and the commands that come next."""
    facts, where = [], shlex.quote(str(run))
    for name in ("test_fitted", "train"):
        part = part_at(metrics, *PROTOCOLS[name].path)
        fitted = " (exposures fitted)" if name != "train" else ""
        if "psnr" in part:
            views = count_of(len(part["per_view"]), "view") + fitted
            facts = [f"{PROTOCOLS[name].views.capitalize()} {part['psnr']:.1f} dB over {views}"]
            break
    facts.append(count_of(metrics["counts"]["gaussians"], "Gaussian"))
    facts.append(duration(whole_run(metrics["seconds"]) or 0.0))
    viewer = "" if has_viewer() else f"   # first: {INSTALL_VIEWER}"
    next_ones = ("view {}" + viewer, "report {}", "export {} --format html")
    lines = [f"{', '.join(facts)}.", "Next:"]
    if part.get("psnr", LOW_DB) < LOW_DB:
        lines.insert(1, VERDICT_ON_LOW)
    lines += [f"  p2gs-jax {command.format(where)}" for command in next_ones]
    lines.append(f"Run folder: {run} (open {run / 'summary.png'} first)")
    PlainConsole().print("\n".join(lines), soft_wrap=True)


def print_metrics(metrics: dict[str, Any]) -> None:
    """Print all scores of a run, and its seconds."""
    console, rows = PlainConsole(), []
    for protocol in PROTOCOLS.values():
        if "psnr" in (part := part_at(metrics, *protocol.path)):
            rows.append((protocol.views, protocol.shown, *scores(part)))
    columns = ("views", "protocol", "PSNR dB", "SSIM", "LPIPS")
    console.print(make_table(columns, rows, "How well it fits"))
    hdr = metrics.get("radiance")
    if hdr:
        console.print(
            f"Radiance against HDR truth: {hdr['stops_median']:.3f} stops median, "
            f"{hdr['stops_rms']:.3f} RMS; PU21 {hdr['pu21_psnr']:.2f} dB / {hdr['pu21_ssim']:.4f}; "
            f"colour difference {hdr['delta_e_itp']:.1f} Delta E ITP; "
            f"mu-law PSNR {hdr['mu_law_psnr']:.2f} dB."
        )
    counts = metrics.get("counts", {})
    if counts:
        console.print(
            f"{counts['gaussians']} Gaussians, {counts['steps']} steps, "
            f"{1e3 * metrics['seconds_per_step']:.0f} ms a step."
        )
    seconds = metrics.get("seconds", {}).items()
    spent = [f"{k.replace('_', ' ')} {v:.0f}" for k, v in seconds if k not in SUMS and v >= 0.5]
    if spent:
        console.print(f"Seconds: {', '.join(spent)}.")


def print_calibration(result: Calibration, out: Path) -> None:
    """Print solved exposures with errors, and gammas and cameras, or the response of a stack."""
    s, seconds = result.solution, result.seconds
    if "signal" in result.details:
        points = [str(count) for count in s.observations_per_view]
        signal = ["yes" if signal else "little" for signal in result.details["signal"]]
        _print_solution(result, {"usable points": points, "signal": signal})
        found = f"response {s.response.name}; residual {s.residual_ev:.2f} EV"
    else:
        _print_solution(result, _tone_columns(result))
        found = (
            f"{result.observations} observations, {100 * s.outliers:.0f} % ignored as outliers; "
            f"residual {s.residual_ev:.2f} EV; {seconds['reading']:.1f} s reading, "
            f"{seconds['adjustment']:.1f} s adjusting"
        )
    lines = [f"Solved: {found}.", f"Results: {out} (open {out / 'calibration.png'} first)"]
    if (done := result.developed) is not None:
        count, page = count_of(len(done.rows), "photograph"), out / "developed.html"
        at = f"at {done.exposure_ev:+.2f} EV, {done.written} of them written now"
        lines = [*done.messages, lines[0], f"Developed: {count} {at}.", lines[1]]
        lines.append(f"Scene for other trainers: {done.folder} ({page} shows what was done)")
    PlainConsole().print("\n".join(lines), soft_wrap=done is not None)


def _print_solution(result: Calibration, more: Mapping[str, list[str]]) -> None:
    console, columns = PlainConsole(), {**_exposure_columns(result), **more}
    rows = zip(*columns.values(), strict=True)
    console.print(
        make_table(tuple(columns), rows, "Exposures in stops from their mean", plain=True)
    )
    for message in result.messages:
        console.print(message)
    s = result.solution
    for camera, errors in zip(s.cameras, s.corner_errors, strict=False):
        if camera.vignetting:
            lost = ", ".join(
                f"{np.log2(left):+.2f} +- {error / LN2:.2f}"
                for left, error in zip(corner(camera), errors, strict=True)
            )
            console.print(f"Camera {camera.name}: {lost} EV in the corners (vignetting).")


def _exposure_columns(result: Calibration) -> dict[str, list[str]]:
    """Return columns by title, without those that are empty or constant."""
    s, views = result.solution, result.views
    errors, stated, gaps = s.exposure_errors_ev, result.stated_ev, result.agreement.gap_ev
    known, has_stated, wrong = np.isfinite(errors), np.isfinite(stated), result.agreement.disagrees
    rows = range(len(views))
    columns = {"view": [v.name for v in views]}
    named = all(v.name.startswith(f"{v.camera}/") for v in views)
    if not named and len({v.camera for v in views}) > 1:
        columns["camera"] = [v.camera for v in views]
    columns["exposure"] = [
        f"{s.exposures_ev[i]:+.3f} +- {errors[i]:.3f}" if known[i] else "unknown" for i in rows
    ]
    if has_stated.any():
        columns["stated"] = [f"{stated[i]:+.3f}" if has_stated[i] else "" for i in rows]
        columns["gap"] = [
            f"{gaps[i]:+.3f}{' !' if wrong[i] else ''}" if np.isfinite(gaps[i]) else ""
            for i in rows
        ]
    return columns


def _tone_columns(result: Calibration) -> dict[str, list[str]]:
    """Return what was solved beside exposures, with standard errors, and residuals in stops."""
    s, rows, columns = result.solution, range(len(result.views)), {}
    known = np.isfinite(s.exposure_errors)
    if (s.gamma_errors[known] > 0).any():
        columns["gamma"] = [
            f"{s.gammas[i]:.2f}"
            + (f" +- {s.gamma_errors[i]:.2f}" if known[i] and s.gamma_errors[i] > 0 else "")
            + (" (weak)" if known[i] and s.gamma_errors[i] > WEAK_GAMMA else "")
            for i in rows
        ]
    residuals = [f"{s.view_residual_ev[i]:.2f}" if known[i] else "" for i in rows]
    return {**columns, **_balance_column(s), "residual": residuals}


def _balance_column(s: PhotometricSolution) -> dict[str, list[str]]:
    """Return gains of red, green and blue, stops, with the largest of their standard errors."""
    if s.white_balance_level is None:
        return {}
    stops, errors = s.white_balance / LN2, s.white_balance_errors.max(1) / LN2
    known = np.isfinite(errors) & np.isfinite(s.exposure_errors)
    gains = [" ".join(f"{ev:+.2f}" for ev in row) for row in stops]
    return {
        "white balance (R G B)": [
            f"{text} +- {error:.2f}" if solved else "unknown"
            for text, error, solved in zip(gains, errors, known, strict=True)
        ]
    }


def print_against(
    against: dict[str, Any], run: Path, metrics: dict[str, Any], remarks: Iterable[str], path: Path
) -> None:
    """Print the scores of other programs in against.json (`path`) beside a run's."""
    fitted = PROTOCOLS["test_fitted"].shown
    protocols = {"averaged": PROTOCOLS["test_averaged"].shown, "as_rendered": "as rendered"}
    protocols |= {"exposure_fitted": fitted, "scale_aligned": "one scale for all"}
    this = Path(run).resolve().name + " (this run)"
    rows, shown = [], []
    for label, program in against["programs"].items():
        views = program["views"]
        # The run's rows appear once, unless programs lack different views.
        if program["missing"] or views not in shown:
            shown.append(views)
            rows += [(this, protocols[n], views, part) for n, part in program["run"].items()]
            if "reference" in program and "reference" in metrics:
                part = metrics["reference"]["scale_aligned"]["test"]
                rows.append((this, "reference, one scale for all", len(part["per_view"]), part))
        for name in ("as_rendered", "exposure_fitted"):
            rows.append((label, protocols[name], views, program[name]))
        for name, part in program.get("reference", {}).items():
            rows.append((label, f"reference, {protocols[name]}", len(part["per_view"]), part))
    columns = ("program", "protocol", "views", "PSNR dB", "SSIM", "LPIPS")
    cells = [(who, how, str(views), *scores(part)) for who, how, views, part in rows]
    console = PlainConsole()
    console.print(make_table(columns, cells, "Held-out views, beside other programs"))
    for remark in remarks:
        console.print(remark)
    console.print(f"Results: {path}")
