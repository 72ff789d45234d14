"""`p2gs-jax calibrate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.table import Table

from p2gs_jax.calibration import WEAK_GAMMA, Calibration, calibrate
from p2gs_jax.commands.console import stdout
from p2gs_jax.config import FitConfig
from p2gs_jax.errors import UserError
from p2gs_jax.numerics import LN2
from p2gs_jax.options.fit import Calibrate, resolve_calibration
from p2gs_jax.progress import TerminalReporter
from p2gs_jax.refine import calibrate_run
from p2gs_jax.static_stack import calibrate_stack, write_stack


def run(options: Calibrate) -> int:
    """Solve the photometry alone; print it as a table."""
    scene, out, compare_with = options.scene, options.out, options.compare_with
    cfg = resolve_calibration(options)
    if options.static:
        return _run_static(scene, out, cfg, compare_with)
    is_run = (scene / "config.json").is_file() and (scene / "radiance.ply").is_file()
    with TerminalReporter() as reporter:
        if is_run:
            if cfg.data != FitConfig().data:
                raise UserError(
                    f"{scene} is a finished run: it keeps its own image size and folder.",
                    fix="leave out --max-width, --images and --data options",
                )
            result = calibrate_run(
                scene, out, cfg.photometry, compare_with=compare_with, reporter=reporter
            )
        else:
            result = calibrate(scene, out, cfg, compare_with=compare_with, reporter=reporter)
    _print_calibration(result)
    stdout().print(f"Results: {out} (open {out / 'calibration.png'} first)")
    return 0


def _run_static(folder: Path, out: Path, cfg: FitConfig, compare_with: str | None) -> int:
    if cfg.data != FitConfig().data:
        raise UserError(
            "--static reads every photograph of the folder at its own size.",
            fix="leave out --max-width, --images and --data options",
        )
    with TerminalReporter() as reporter:
        reporter.stage("Solving the stack")
        result = calibrate_stack(
            folder,
            known=cfg.photometry.known,
            known_deviation_ev=cfg.photometry.known_deviation_ev,
            compare_with=compare_with,
        )
        write_stack(result, out)
    console, s = stdout(), result.solution
    table = Table(title="Exposures in stops from their mean", title_justify="left")
    table.add_column("frame")
    for name in ("exposure", "stated", "usable points", "signal"):
        table.add_column(name, justify="right")
    for i, name in enumerate(result.names):
        error = s.exposure_errors[i] / LN2
        table.add_row(
            name,
            f"{s.exposures_ev[i]:+.2f} +- {error:.2f}" if np.isfinite(error) else "unknown",
            f"{result.stated_ev[i]:+.2f}" if np.isfinite(result.stated_ev[i]) else "",
            str(s.observations_per_view[i]),
            "yes" if result.signal[i] else "little",
        )
    console.print(table)
    for message in result.messages:
        console.print(message)
    console.print(f"Response: {s.response.name}; residual {s.residual_ev:.2f} EV. Results: {out}")
    return 0


def _print_calibration(result: Calibration) -> None:
    """Print exposures and gammas with their standard errors, and what to make of them."""
    console, s = stdout(), result.selection.solution
    table = Table(title="Exposures in stops from their mean", title_justify="left")
    table.add_column("view")
    table.add_column("camera")
    for name in ("exposure", "EXIF or file", "gap", "gamma", "residual EV"):
        table.add_column(name, justify="right")
    stated = result.stated_ev
    for i, view in enumerate(result.scene.views):
        error = s.exposure_errors[i] / LN2
        known = bool(np.isfinite(error))
        weak = " (weakly identified)" if s.gamma_errors[i] > WEAK_GAMMA else ""
        given = np.isfinite(stated[i])
        table.add_row(
            view.name,
            view.camera,
            f"{s.exposures_ev[i]:+.2f} +- {error:.2f}" if known else "unknown",
            f"{stated[i]:+.2f}" if given else "",
            f"{result.agreement.gap_ev[i]:+.2f}" + (" !" if result.agreement.disagrees[i] else "")
            if given and known
            else "",
            f"{s.gammas[i]:.2f} +- {s.gamma_errors[i]:.2f}{weak}"
            if known and s.gamma_errors[i] > 0
            else f"{s.gammas[i]:.2f}",
            f"{s.view_residual_ev[i]:.2f}" if known else "",
        )
    console.print(table)
    for message in result.messages:
        console.print(message)
    console.print(
        f"{result.observations} observations, {100 * s.outliers:.0f} % ignored as outliers; "
        f"residual {s.residual_ev:.2f} EV; {result.seconds['reading']:.1f} s reading, "
        f"{result.seconds['adjustment']:.1f} s adjusting."
    )
