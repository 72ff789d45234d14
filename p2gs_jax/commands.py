"""What each subcommand does, once its options are parsed."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from p2gs_jax.calibration import WEAK_GAMMA, Calibration, calibrate
from p2gs_jax.config import FitConfig
from p2gs_jax.demo import run_demo
from p2gs_jax.errors import UserError
from p2gs_jax.evaluate.alignment import fit_exposure
from p2gs_jax.evaluate.evaluate import ViewResult, evaluate, mean_parameters
from p2gs_jax.evaluate.lpips_weights import read_lpips_weights
from p2gs_jax.export.atomic import write_json
from p2gs_jax.finish import find_radiance, load_reference, tone_function, write_view
from p2gs_jax.numerics import LN2
from p2gs_jax.pipeline import fit
from p2gs_jax.progress import TerminalReporter
from p2gs_jax.refine import calibrate_run
from p2gs_jax.render.host import make_renderer
from p2gs_jax.run_folder import load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.static_stack import calibrate_stack, write_stack
from p2gs_jax.sweep import read_sweep, sweep
from p2gs_jax.synth.rig import image_height
from p2gs_jax.synth.sensor import Sensor
from p2gs_jax.synth.write import write_street


def _out() -> Console:
    return Console(highlight=False)


def fit_command(
    scene: Path, out: Path, cfg: FitConfig, reference: Path | None, resume: bool
) -> int:
    """Fit a scene; print where the results are and how good they are."""
    with TerminalReporter() as reporter:
        result = fit(scene, out, cfg, reference=reference, resume=resume, reporter=reporter)
    print_metrics(result.metrics, out)
    return 0


def calibrate_command(
    scene: Path, out: Path, cfg: FitConfig, compare_with: str | None, static: bool
) -> int:
    """Solve the photometry alone; print it as a table."""
    if static:
        return _static_command(scene, out, cfg, compare_with)
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
    print_calibration(result)
    _out().print(f"Results: {out} (open {out / 'calibration.png'} first)")
    return 0


def _static_command(folder: Path, out: Path, cfg: FitConfig, compare_with: str | None) -> int:
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
    console, s = _out(), result.solution
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


def print_calibration(result: Calibration) -> None:
    """Print exposures and gammas with their standard errors, and what to make of them."""
    console, s = _out(), result.selection.solution
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


def print_metrics(metrics: dict, out: Path) -> None:
    """Print the scores of a run as a table."""
    console = _out()
    table = Table(title="How well it fits", title_justify="left")
    for name in ("views", "protocol", "PSNR dB", "SSIM", "LPIPS"):
        table.add_column(name, justify="left" if name in ("views", "protocol") else "right")

    def row(views: str, protocol: str, part: dict | None) -> None:
        if part and "psnr" in part:
            lpips = f"{part['lpips']:.4f}" if "lpips" in part else "n/a"
            table.add_row(views, protocol, f"{part['psnr']:.2f}", f"{part['ssim']:.4f}", lpips)

    row("training", "own exposure and gamma", metrics["train"])
    row("training", "mean parameters", metrics["train"]["averaged"])
    row("held out", "mean parameters", metrics["test"]["averaged"])
    row("held out", "exposure fitted to each photograph", metrics["test"]["exposure_fitted"])
    for name, part in metrics.get("reference", {}).items():
        row("all", f"reference photographs, {name.replace('_', ' ')}", part)
        row("held out", f"reference photographs, {name.replace('_', ' ')}", part["test"])
    console.print(table)
    hdr = metrics.get("radiance")
    if hdr:
        console.print(
            f"Radiance against HDR truth: {hdr['stops_median']:.3f} stops median, "
            f"{hdr['stops_rms']:.3f} RMS; PU21 {hdr['pu21_psnr']:.2f} dB / {hdr['pu21_ssim']:.4f}; "
            f"colour difference {hdr['delta_e_itp']:.1f} Delta E ITP."
        )
    counts = metrics.get("counts", {})
    if counts:
        console.print(
            f"{counts['gaussians']} Gaussians, {counts['steps']} steps, "
            f"{1e3 * metrics['seconds_per_step']:.0f} ms a step."
        )
    console.print(f"Results: {out} (open {out / 'summary.png'} first)")


def render_command(
    run_dir: Path, out: Path | None, split: str, exposure_ev: float | None, gamma: float | None
) -> int:
    """Render views of a run as EXR and PNG."""
    if split not in ("all", "train", "test"):
        raise UserError(f"--split {split!r} is unknown.", fix="choose all, train or test")
    if gamma is not None and gamma <= 0:
        raise UserError("--gamma must be positive.")
    run = load_run(run_dir)
    folder = out or run_dir / "renders" / "all"
    store = ImageStore(run.scene.views, run.cfg.data)
    render = make_renderer(run.cfg.render)
    mean = mean_parameters(run.params.photometry)
    exposures = np.asarray(run.params.photometry.exposures)
    gammas = np.asarray(run.params.photometry.gammas)
    mean_correction = run.params.mean_correction
    row_of = {index: k for k, index in enumerate(run.scene.train_indices)}
    alive = jnp.ones(run.params.gaussians.capacity, bool)
    rows = [i for i, v in enumerate(run.scene.views) if split in ("all", v.split)]
    begin = time.monotonic()
    with TerminalReporter() as reporter:
        for done, index in enumerate(rows):
            photograph, mask = store.get(index, 1)
            result = render(run.params.gaussians, alive, camera_of(store, index))
            k = row_of.get(index)
            g = gamma if gamma is not None else (mean.gamma if k is None else float(gammas[k]))
            if k is None or exposure_ev is not None:
                correction = mean_correction
            else:
                correction = run.params.correction(k)
            if exposure_ev is not None:
                e = mean.exposure_geometric * 2**exposure_ev
            elif k is not None:
                e = float(exposures[k])
            else:
                tone = run.cfg.photometry
                e = float(fit_exposure(result.linear, photograph, mask, g, tone, correction))
            view = ViewResult(
                index,
                np.asarray(result.linear),
                np.asarray(result.alpha),
                np.asarray(result.depth),
                tone_function(e, g, run.cfg, correction)(result.linear),
                photograph,
                e,
                g,
            )
            write_view(folder, run.scene.views[index].name, view, store)
            reporter.stage("Rendering", done + 1, len(rows))
    _out().print(f"{len(rows)} views in {time.monotonic() - begin:.1f} s: {folder}")
    return 0


def eval_command(run_dir: Path, reference: Path | None, lpips_weights: str | None) -> int:
    """Judge a run again and rewrite its metrics.

    Args:
        run_dir: the run folder.
        reference: replaces the run's.
        lpips_weights: replaces the run's; `none` leaves LPIPS out.
    """
    run = load_run(run_dir)
    lpips_weights = lpips_weights or run.cfg.evaluation.lpips_weights
    left_out = lpips_weights in (None, "none")
    weights = None if left_out else read_lpips_weights(lpips_weights)
    if weights is not None:
        weights.require_sizes(run.scene.views, run.cfg.data.max_width)
    folder = reference or run.reference
    truth = None if folder is None else load_reference(folder, run.scene, run.cfg)
    store = ImageStore(run.scene.views, run.cfg.data)
    with TerminalReporter() as reporter:
        metrics = evaluate(
            run.params,
            np.ones(run.params.gaussians.capacity, bool),
            run.scene,
            store,
            make_renderer(run.cfg.render),
            run.cfg,
            reference=truth,
            radiance=find_radiance(run.scene, store),
            lpips_weights=weights,
            on_progress=lambda done, count: reporter.stage("Evaluating", done, count),
        )
    path = run_dir / "metrics.json"
    kept = _kept_metrics(path)
    write_json(path, {**metrics, **kept})
    print_metrics({**metrics, **kept}, run_dir)
    return 0


def _kept_metrics(path: Path) -> dict:
    """Return what only the fit itself knows: counts, times, notes."""
    try:
        old = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    kept = ("counts", "seconds", "seconds_per_step", "notes", "growth")
    return {k: old[k] for k in kept if k in old}


def demo_command(
    out: Path,
    cfg: FitConfig,
    *,
    budget_s: float,
    frames: int,
    width: int,
    iso_std: float,
    seed: int,
) -> int:
    """Make a street, fit it, and print recovered against true exposures."""
    cfg = dataclasses.replace(
        cfg, train=dataclasses.replace(cfg.train, budget_s=budget_s, seed=seed)
    )
    with TerminalReporter() as reporter:
        result = run_demo(
            out, cfg, frames=frames, width=width, iso_std=iso_std, seed=seed, reporter=reporter
        )
    console = _out()
    table = Table(title="Exposures, in stops from their mean", title_justify="left")
    for name in ("view", "true", "recovered", "error"):
        table.add_column(name, justify="left" if name == "view" else "right")
    for name, true, found in result.rows:
        table.add_row(name, f"{true:+.2f}", f"{found:+.2f}", f"{found - true:+.3f}")
    console.print(table)
    console.print(
        f"Exposure error: {result.error['ev']:.3f} EV RMS after scale alignment "
        f"(largest {result.error['ev_max']:.3f})."
    )
    print_metrics(result.metrics, result.run_dir)
    return 0


def synth_command(out: Path, sensor: Sensor, *, width: int, **options) -> int:
    """Make a data set.

    Args:
        out: folder to create.
        sensor: what the cameras do to the light.
        width: pixels.
        options: see `write_street`.
    """
    console = _out()
    begin = time.monotonic()
    height = image_height(width)
    write_street(out, sensor=sensor, width=width, height=height, report=console.print, **options)
    console.print(f"{time.monotonic() - begin:.0f} s. Fit it: p2gs-jax fit {out} --out RUN")
    return 0


def sweep_command(path: Path, out: Path | None, max_parallel: int | None) -> int:
    """Run a sweep and print its table; 1 where a run failed.

    Args:
        path: see `read_sweep`.
        out: replaces the file's folder.
        max_parallel: replaces the file's number.
    """
    console = _out()
    wanted = read_sweep(path)
    result = sweep(
        wanted.scene,
        out or wanted.out,
        wanted.configs,
        seeds=wanted.seeds,
        reference=wanted.reference,
        max_parallel=max_parallel or wanted.max_parallel,
        report=lambda line: console.print(Text(line)),
    )
    print(result.to_markdown())
    console.print(Text(f"Results: {result.out} (sweep.json, sweep.md)"))
    return 0 if all(row["status"] == "done" for row in result.rows) else 1


def bench_command(
    parts: tuple[str, ...],
    out: Path,
    quick: bool,
    baseline: Path | None,
    write_baseline: Path | None,
) -> int:
    """Run benches, print their tables; 1 where something is worse than the baseline allows."""
    # Imported here: its scenes are arrays, and other commands should not wait for them.
    from p2gs_jax.bench import run as benches

    for name in parts:
        if name not in benches.PARTS:
            raise UserError(
                f"there is no bench {name!r}.", fix=f"choose {', '.join(benches.PARTS)}"
            )
    chosen: tuple[benches.Part, ...] = tuple(p for p in benches.PARTS if not parts or p in parts)
    if (baseline or write_baseline) and "speed_error" not in chosen:
        raise UserError("a baseline concerns speed_error.", fix="name that part as well")
    with TerminalReporter() as reporter:
        text, complaints = benches.run(
            chosen,
            out=out,
            quick=quick,
            baseline=baseline,
            write_baseline=write_baseline,
            on_progress=reporter.stage,
        )
    print(text)
    print(f"Results: {out}")
    for complaint in complaints:
        print(f"WORSE than {baseline}: {complaint}")
    return 1 if complaints else 0
