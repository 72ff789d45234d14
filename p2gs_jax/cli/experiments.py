"""`demo`, `synth` and `sweep`: data with known exposures, and many fits."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.config import PresetName
from p2gs_jax.options import check_values
from p2gs_jax.presets import preset
from p2gs_jax.synth.settings import Layout, Sensor


@dataclass(frozen=True)
class Demo:
    """Make a small street with known exposures, fit it, and compare.

    The demo takes three minutes on two cores; open its summary.png first.

        p2gs-jax demo
        p2gs-jax demo --out runs/paper --preset paper --budget 5m
    """

    out: Path = Path("runs/demo")
    """Folder for the street and the run."""
    preset: Annotated[PresetName, tyro.conf.arg(metavar="NAME")] = "robust"
    """Preset of `fit` (p2gs-jax fit --help)."""
    budget: Annotated[float, tyro.conf.arg(metavar="TIME")] = 125.0
    """Wall-clock limit of the fit: 90s, 20m or 1h30m."""
    frames: int = 10
    """Number of frames per camera."""
    width: int = 320
    """Image width, pixels."""
    iso_std: float = 4.0
    """Standard deviation of the ISO, whose mean is 8."""
    seed: int = 0
    """Random seed of the street, its exposures and the fit."""

    def execute(self) -> int:
        """Make a street, fit it, and compare the recovered exposures with the true ones."""
        from p2gs_jax.cli.tables import print_headline
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.core.runtime import use_cores
        from p2gs_jax.pipeline.demo import run_demo

        use_cores()
        cfg = preset(self.preset)
        train = dataclasses.replace(cfg.train, budget_s=self.budget, seed=self.seed)
        cfg = dataclasses.replace(cfg, train=train)
        check_values(cfg)
        with TerminalReporter() as reporter:
            street = {"frames": self.frames, "width": self.width, "iso_std": self.iso_std}
            rows, error, metrics = run_demo(
                self.out, cfg, seed=self.seed, reporter=reporter, **street
            )
        true, found = zip(*rows, strict=True)
        PlainConsole().print(
            f"Exposures of {len(true)} views, EV from their mean: true {min(true):+.2f} to "
            f"{max(true):+.2f}, recovered {min(found):+.2f} to {max(found):+.2f}, error "
            f"{error['ev']:.3f} RMS and at most {error['ev_max']:.3f}."
        )
        print_headline(metrics, self.out / "run")
        return 0


@dataclass(frozen=True)
class Synth:
    """Make a data set by the paper's protocol, with linear HDR truth.

    Three cameras drive through a procedural town (docs/scenes.md).

        p2gs-jax synth town --seed 1
        p2gs-jax synth constant --sensor.iso-std 0 --frames 20 --width 240
    """

    out: Annotated[Path, tyro.conf.Positional]
    """Folder to create."""
    sensor: Sensor = field(default_factory=Sensor)
    """Image formation of the cameras."""
    frames: int = 100
    """Number of frames per camera (paper: 100, at 10 Hz)."""
    width: int = 480
    """Image width, pixels (paper: 1920); the height follows as 1300 / 1920 of it."""
    layout: Layout = "town"
    """Layout of the town. town: an underpass, and another sun for every seed; street: the demo's
    layout; long: streets one behind another."""
    matte: bool = False
    """Surfaces have no gloss: every view sees the same radiance."""
    supersample: int | None = None
    """Samples per pixel along each axis (default: 2, or 8 with --matte)."""
    points: int = 60_000
    """Number of seed points of the COLMAP model; points in only one view are dropped."""
    seed: int = 0
    """Random seed of the town, the ISO and the points."""

    def execute(self) -> int:
        """Make the data set."""
        import time

        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.synth.settings import image_height
        from p2gs_jax.synth.write import write_street

        begin = time.monotonic()
        options = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        out = options.pop("out")
        with TerminalReporter() as reporter:
            height, report = image_height(self.width), reporter.message
            write_street(out, height=height, report=report, **options)
        seconds = time.monotonic() - begin
        PlainConsole().print(f"{out}, in {seconds:.0f} s. Next: p2gs-jax fit {out}")
        return 0


@dataclass(frozen=True)
class Sweep:
    """Fit a scene under many configurations and seeds, into one table.

    The same command continues an interrupted sweep; finished runs are kept.

        p2gs-jax sweep sweep.toml
        p2gs-jax sweep sweep.toml --out runs/sweep --jobs 2
    """

    file: Annotated[Path, tyro.conf.Positional]
    """TOML file of the sweep (docs/api.md)."""
    out: Path | None = None
    """Folder of the runs and the table (default: `out` of the file, or the file's name)."""
    jobs: int | None = None
    """Number of fits at a time on this machine (default: `max_parallel` of the file, or 1)."""
    engine: Annotated[str, tyro.conf.arg(metavar="NAME")] = "local"
    """Where fits run: local, dask://HOST:PORT, or slurm:OPTION=VALUE,... (docs/api.md)."""

    def execute(self) -> int:
        """Run the sweep and print its table; return 1 if a run is not finished."""
        from functools import partial

        from p2gs_jax.cli.tables import make_table
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.jobs.configs import read_sweep
        from p2gs_jax.jobs.sweep import brief, failures, sweep
        from p2gs_jax.jobs.table import show

        console, wanted = PlainConsole(), dict(vars(read_sweep(self.file)))
        options = {"out": self.out, "max_parallel": self.jobs}
        wanted |= {name: value for name, value in options.items() if value is not None}
        with TerminalReporter() as reporter:
            shown = {"report": reporter.message, "on_look": partial(show, reporter)}
            result = sweep(**wanted, engine=self.engine, **shown)
        console.print(make_table(*brief(result.rows)))
        for line in failures(result.rows):
            console.print(f"Not finished: {line}")
        console.print(
            "Scores and the seconds of whole runs are means over seeds; each held-out view has a "
            f"fitted exposure. All columns are in {result.out / 'sweep.md'} (and sweep.json)."
        )
        return 0 if all(row["status"] == "done" for row in result.rows) else 1
