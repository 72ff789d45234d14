"""`demo`, `synth` and `sweep`: data with truth, and many fits."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.cli.fit import checked
from p2gs_jax.config import PresetName
from p2gs_jax.presets import preset
from p2gs_jax.synth.settings import Layout, Sensor


@dataclass(frozen=True)
class Demo:
    """Make a small street with known exposures, fit it, and compare.

    Takes three minutes on two cores; open its summary.png first.

        p2gs-jax demo
        p2gs-jax demo --out runs/paper --preset paper --budget 5m
    """

    out: Path = Path("runs/demo")
    """Folder for the street and the run."""
    preset: Annotated[PresetName, tyro.conf.arg(metavar="NAME")] = "robust"
    """A preset of `fit`: robust, paper, paper_appendix, 3dgs, 3dgs_published, 3dgs_gain,
    3dgs_affine, 3dgs_bilateral, 3dgs_curve, luminance_gs, ppisp or ppisp_solved."""
    budget: Annotated[float, tyro.conf.arg(metavar="TIME")] = 125.0
    """Wall-clock limit of the fit: 90s, 20m or 1h30m."""
    frames: int = 10
    """Frames per camera."""
    width: int = 320
    """Image width, pixels."""
    iso_std: float = 4.0
    """Standard deviation of the ISO about 8."""
    seed: int = 0
    """Seeds the street, its exposures and the fit."""

    def execute(self) -> int:
        """Make a street, fit it, and print recovered against true exposures."""
        from p2gs_jax.cli.tables import make_table, print_metrics, stdout
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.core.runtime import use_cores
        from p2gs_jax.pipeline.demo import run_demo

        use_cores()
        cfg = preset(self.preset)
        train = dataclasses.replace(cfg.train, budget_s=self.budget, seed=self.seed)
        cfg = checked(dataclasses.replace(cfg, train=train))
        with TerminalReporter() as reporter:
            result = run_demo(
                self.out,
                cfg,
                frames=self.frames,
                width=self.width,
                iso_std=self.iso_std,
                seed=self.seed,
                reporter=reporter,
            )
        rows = [
            (name, f"{true:+.2f}", f"{found:+.2f}", f"{found - true:+.3f}")
            for name, true, found in result.rows
        ]
        columns = ("view", "true", "recovered", "error")
        stdout().print(make_table(columns, rows, "Exposures, in stops from their mean"))
        stdout().print(
            f"Exposure error: {result.error['ev']:.3f} EV RMS after scale alignment "
            f"(largest {result.error['ev_max']:.3f})."
        )
        print_metrics(result.metrics, result.run_dir)
        return 0


@dataclass(frozen=True)
class Synth:
    """Make a data set by the paper's protocol, with linear HDR truth.

    A drive through a procedural town by three cameras and a LiDAR (docs/scenes.md).

        p2gs-jax synth town --seed 1
        p2gs-jax synth constant --sensor.iso-std 0 --frames 20 --width 240
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder to create."""
    sensor: Sensor = field(default_factory=Sensor)
    """What the cameras do to the light."""
    frames: int = 100
    """Frames per camera (paper: 100, at 10 Hz)."""
    width: int = 480
    """Image width, pixels (paper: 1920); the height follows as 1300 / 1920 of it."""
    layout: Layout = "town"
    """town: with an underpass and a sun of its own for every seed; matte: the same without gloss,
    for clean experiments on exposures; street: the demo's; long: streets one behind another, as
    long as the drive."""
    supersample: int | None = None
    """Samples a pixel along each axis (default: 2, of a matte town 8)."""
    points: int = 60_000
    """Seed points sampled for the COLMAP model; those seen once are dropped."""
    seed: int = 0
    """Seeds the town, the ISO and the points."""

    def execute(self) -> int:
        """Make the data set."""
        import time

        from p2gs_jax.cli.tables import stdout
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.synth.settings import image_height
        from p2gs_jax.synth.write import write_street

        begin = time.monotonic()
        options = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        out = options.pop("out")
        with TerminalReporter() as reporter:
            height, report = image_height(self.width), reporter.message
            write_street(out, height=height, report=report, **options)
        seconds = time.monotonic() - begin
        stdout().print(f"{out}, in {seconds:.0f} s. Fit it: p2gs-jax fit {out} --out RUN")
        return 0


@dataclass(frozen=True)
class Sweep:
    """Fit a scene under many configurations and seeds, into one table.

    Run it again to continue: finished runs are kept.

        p2gs-jax sweep sweep.toml
        p2gs-jax sweep sweep.toml --out runs/sweep --max-parallel 2
    """

    file: Annotated[Path, tyro.conf.Positional]
    """TOML file; docs/api.md says what it may contain."""
    out: Path | None = None
    """Folder of the runs and the table (default: the file's, or its name)."""
    max_parallel: int | None = None
    """Fits at a time on this machine (default: the file's, or 1)."""
    engine: Annotated[str, tyro.conf.arg(metavar="NAME")] = "local"
    """Where fits run: local, dask://HOST:PORT, or slurm:OPTION=VALUE,... (docs/api.md)."""

    def execute(self) -> int:
        """Run the sweep and print its table; 1 where a run failed."""
        from functools import partial

        from p2gs_jax.cli.tables import make_table, stdout
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.jobs.configs import read_sweep
        from p2gs_jax.jobs.sweep import brief, failures, sweep
        from p2gs_jax.jobs.table import show

        console, wanted = stdout(), dict(vars(read_sweep(self.file)))
        own = {"out": self.out, "max_parallel": self.max_parallel}
        wanted |= {name: value for name, value in own.items() if value is not None}
        with TerminalReporter() as reporter:
            result = sweep(
                **wanted,
                engine=self.engine,
                report=reporter.message,
                on_look=partial(show, reporter),
            )
        console.print(make_table(*brief(result.rows)))
        for line in failures(result.rows):
            console.print(f"Not finished: {line}")
        console.print(
            "Means over seeds; seconds of whole runs; held-out views with the exposure fitted to "
            f"each. Every column, and what it means: {result.out / 'sweep.md'} (and sweep.json)."
        )
        return 0 if all(row["status"] == "done" for row in result.rows) else 1
