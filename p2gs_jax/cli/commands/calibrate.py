"""`p2gs-jax calibrate`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.fit import Calibrate, resolve_calibration
from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.formation import corner
from p2gs_jax.photometry.solution import WEAK_GAMMA, PhotometricSolution
from p2gs_jax.pipeline.calibrate import calibrate
from p2gs_jax.pipeline.calibrate_of import STEPS, calibrate_of
from p2gs_jax.pipeline.calibrate_run import calibrate_run
from p2gs_jax.pipeline.calibrate_stack import calibrate_stack
from p2gs_jax.pipeline.calibration import CalibrationResult, write_calibration


def run(options: Calibrate) -> int:
    """Solve the photometry alone; print it as a table."""
    scene, out, compare_with = options.scene, options.out, options.compare_with
    cfg = resolve_calibration(options)
    if options.static:
        return _run_static(scene, out, cfg, compare_with)
    is_run = (scene / "config.json").is_file() and (scene / "radiance.ply").is_file()
    if options.of is not None:
        if is_run:
            raise UserError(
                f"{scene} is a finished run; --of needs the photographs with their poses.",
                fix="name the scene that the run was fitted to",
            )
        return _run_of(options, options.of, cfg)
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
    s, seconds = result.solution, result.seconds
    _print_table(result, _tone_columns(result))
    for line in _camera_lines(s):
        stdout().print(line)
    stdout().print(
        f"{result.observations} observations, {100 * s.outliers:.0f} % ignored as outliers; "
        f"residual {s.residual_ev:.2f} EV; {seconds['reading']:.1f} s reading, "
        f"{seconds['adjustment']:.1f} s adjusting."
    )
    stdout().print(f"Results: {out} (open {out / 'calibration.png'} first)")
    return 0


def _run_of(options: Calibrate, model: Path, cfg: FitConfig) -> int:
    with TerminalReporter() as reporter:
        found = calibrate_of(
            model,
            options.scene,
            options.out,
            cfg,
            steps=STEPS if options.steps is None else options.steps,
            compare_with=options.compare_with,
            reporter=reporter,
        )
    _print_table(found.calibration, _tone_columns(found.calibration))
    for line in _camera_lines(found.calibration.solution):
        stdout().print(line)
    for split, name in (("train", "training"), ("test", "held-out")):
        if split in found.metrics["of"]:
            stdout().print(_before_and_after(found.metrics, split, name))
    stdout().print(f"Results: {options.out} (a run folder: view, render, export, report read it)")
    return 0


def _before_and_after(metrics: dict, split: str, name: str) -> str:
    """Return a sentence on the photographs of a split, by the model and by what became of it."""
    old, new = metrics["of"][split], metrics[split]
    by_view = new["exposure_fitted"] if split == "test" else new
    how = "fitted to each" if split == "test" else "as solved"
    return (
        f"PSNR of {name} views: {old['as_it_is']['psnr']:.2f} dB as the model was, "
        f"{old['exposure_fitted']['psnr']:.2f} with a gain fitted to each; now "
        f"{by_view['psnr']:.2f} with exposures {how}."
    )


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
        write_calibration(result, out)
    s = result.solution
    _print_table(
        result,
        {
            "usable points": [str(count) for count in s.observations_per_view],
            "signal": ["yes" if signal else "little" for signal in result.signal],
        },
    )
    stdout().print(f"Response: {s.response.name}; residual {s.residual_ev:.2f} EV. Results: {out}")
    return 0


def _print_table(result: CalibrationResult, more: dict[str, list[str]]) -> None:
    """Print exposures with their standard errors, and the notes.

    Args:
        result: of any source.
        more: further columns by title.
    """
    console, columns = stdout(), {**_exposure_columns(result), **more}
    table = Table(title="Exposures in stops from their mean", title_justify="left", box=SIMPLE)
    for name in columns:
        table.add_column(name, justify="left" if name in ("view", "camera") else "right")
    for row in zip(*columns.values(), strict=True):
        table.add_row(*row)
    console.print(table)
    for message in result.messages:
        console.print(message)


def _exposure_columns(result: CalibrationResult) -> dict[str, list[str]]:
    """Return columns by title, without those that are empty or constant."""
    s, views = result.solution, result.views
    errors, stated, gaps = s.exposure_errors_ev, result.stated_ev, result.agreement.gap_ev
    known, given, wrong = np.isfinite(errors), np.isfinite(stated), result.agreement.disagrees
    rows = range(len(views))
    columns = {"view": [v.name for v in views]}
    if len({v.camera for v in views}) > 1:
        columns["camera"] = [v.camera for v in views]
    columns["exposure"] = [
        f"{s.exposures_ev[i]:+.2f} +- {errors[i]:.2f}" if known[i] else "unknown" for i in rows
    ]
    if given.any():
        columns["stated"] = [f"{stated[i]:+.2f}" if given[i] else "" for i in rows]
        columns["gap"] = [
            f"{gaps[i]:+.2f}{' !' if wrong[i] else ''}" if np.isfinite(gaps[i]) else ""
            for i in rows
        ]
    return columns


def _tone_columns(result: CalibrationResult) -> dict[str, list[str]]:
    """Return gammas with their standard errors, and residuals in stops."""
    s, rows = result.solution, range(len(result.views))
    known = np.isfinite(s.exposure_errors)
    gammas = [
        f"{s.gammas[i]:.2f}"
        + (f" +- {s.gamma_errors[i]:.2f}" if known[i] and s.gamma_errors[i] > 0 else "")
        + (" (weak)" if known[i] and s.gamma_errors[i] > WEAK_GAMMA else "")
        for i in rows
    ]
    residuals = [f"{s.view_residual_ev[i]:.2f}" if known[i] else "" for i in rows]
    return {"gamma": gammas, **_balance_column(s), "residual": residuals}


def _camera_lines(s: PhotometricSolution) -> list[str]:
    """Return a sentence on the vignetting of each camera that has any."""
    said = []
    for camera, errors in zip(s.cameras, s.corner_errors, strict=False):
        if camera.vignetting:
            lost = ", ".join(
                f"{np.log2(left):+.2f} +- {error / LN2:.2f}"
                for left, error in zip(corner(camera), errors, strict=True)
            )
            said.append(f"Camera {camera.name}: {lost} EV in the corners (vignetting).")
    return said


def _balance_column(s: PhotometricSolution) -> dict[str, list[str]]:
    """Return gains of red, green and blue, stops, with the largest of their standard errors."""
    if s.white_balance_level is None:
        return {}
    stops, errors = s.white_balance / LN2, s.white_balance_errors.max(1) / LN2
    known = np.isfinite(errors) & np.isfinite(s.exposure_errors)
    said = [" ".join(f"{ev:+.2f}" for ev in row) for row in stops]
    return {
        "white balance (R G B)": [
            f"{text} +- {error:.2f}" if seen else "unknown"
            for text, error, seen in zip(said, errors, known, strict=True)
        ]
    }
