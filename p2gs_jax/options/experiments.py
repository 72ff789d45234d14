"""`demo`, `synth`, `sweep` and `bench`: data with truth, many fits, and measurements."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.synth.sensor import Sensor
from p2gs_jax.synth.town import Layout


@dataclass(frozen=True)
class Demo:
    """Make a small street with known exposures, fit it, and compare."""

    out: Path = Path("runs/demo")
    """Folder for the street and the run."""
    preset: str = "robust"
    """A preset of `fit`: robust, paper, paper_appendix, 3dgs, 3dgs_gain, 3dgs_affine,
    3dgs_bilateral or 3dgs_curve."""
    budget: str = "150s"
    """Wall-clock limit of the fit."""
    frames: int = 10
    """Frames per camera."""
    width: int = 320
    """Image width, pixels."""
    iso_std: float = 4.0
    """Standard deviation of the ISO about 8."""
    seed: int = 0
    """Seeds the street, its exposures and the fit."""


@dataclass(frozen=True)
class Synth:
    """Make a data set by the paper's protocol: a drive through a town by three cameras and a
    LiDAR, with linear HDR truth."""

    out: Annotated[Path, tyro.conf.Positional]
    """Folder to create."""
    sensor: Sensor = field(default_factory=Sensor)
    """What the cameras do to the light."""
    frames: int = 100
    """Frames per camera (paper: 100, at 10 Hz)."""
    width: int = 480
    """Image width, pixels (paper: 1920); the height follows as 1300 / 1920 of it."""
    layout: Layout = "town"
    """town: with an underpass and a sun of its own for every seed; street: the demo's."""
    supersample: int = 2
    """Samples a pixel along each axis."""
    points: int = 60_000
    """Seed points sampled for the COLMAP model; those seen once are dropped."""
    lidar: bool = True
    """Write KITTI's calibration, poses and LiDAR scans."""
    seed: int = 0
    """Seeds the town, the ISO and the points."""


@dataclass(frozen=True)
class Sweep:
    """Fit a scene under many configurations and seeds, into one table; run again to continue."""

    file: Annotated[Path, tyro.conf.Positional]
    """TOML file; docs/sweeps.md says what it may contain."""
    out: Path | None = None
    """Folder of the runs and the table (default: the file's, or its name)."""
    max_parallel: int | None = None
    """Fits at a time (default: the file's, or 1)."""


@dataclass(frozen=True)
class Bench:
    """Measure the renderer on this machine: speed against error, growth, memory, hard cases."""

    parts: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """speed_error, growth, memory, step, hard_cases, implementations; none named runs all."""
    out: Path = Path("runs/bench")
    """Folder for tables, JSON and plots."""
    quick: bool = False
    """Fewer and smaller: two minutes instead of half an hour."""
    baseline: Path | None = None
    """Compare speed_error with this file; exit code 1 where it is worse."""
    write_baseline: Path | None = None
    """Write what speed_error measured, for a later --baseline."""
