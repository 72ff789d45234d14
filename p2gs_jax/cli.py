"""The command line: `p2gs-jax fit | calibrate | render | eval | demo | synth | sweep | bench`.

Every configuration field is an option. Bad input ends with one message and exit code 2.
"""

from __future__ import annotations

import dataclasses
import os
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args

# Quiet the native libraries before they load; our own messages say what matters.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("GLOG_minloglevel", "2")

import tyro

from p2gs_jax import config as configs
from p2gs_jax.errors import UserError
from p2gs_jax.synth.sensor import Sensor
from p2gs_jax.synth.town import Layout

PRESETS: tuple[configs.PresetName, ...] = get_args(configs.PresetName)


def parse_duration(text: str) -> float:
    """Return seconds of `90`, `90s`, `5m`, `1h30m`.

    Raises:
        UserError: the text is no duration.
    """
    match = re.fullmatch(r"(?:(\d+)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s?)?", text.strip())
    if match is None or not any(match.groups()):
        raise UserError(f"--budget {text!r} is no duration.", fix="write 90s, 5m or 1h30m")
    hours, minutes, seconds = (float(g or 0) for g in match.groups())
    total = 3600 * hours + 60 * minutes + seconds
    if total <= 0:
        raise UserError(f"--budget {text!r} leaves no time.", fix="write 90s, 5m or 1h30m")
    return total


def parse_gaussians(text: str) -> int | Literal["auto"]:
    """Return what `--gaussians` says: a whole number from 1 on, or `auto`.

    Raises:
        UserError: it is neither.
    """
    if text == "auto":
        return "auto"
    if re.fullmatch(r"\d+", text) is None or int(text) < 1:
        raise UserError(
            f"--gaussians {text!r} is no number of Gaussians.",
            fix="write a whole number from 1 on, or auto",
        )
    return int(text)


@dataclass(frozen=True)
class Fit:
    """Fit a linear HDR radiance field, exposures and gammas to photographs."""

    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, or a folder of photographs."""
    out: Path
    """Run folder to create."""
    config: Annotated[configs.FitConfig, tyro.conf.arg(name="")]
    steps: int | None = None
    """Optimisation steps (default: the preset's)."""
    budget: str | None = None
    """Wall-clock limit for the whole run, such as 5m; replaces --steps."""
    max_width: int | None = None
    """Shrink images to at most this many pixels across."""
    gaussians: str | None = None
    """Upper bound on the Gaussians: a whole number, or auto (grow while held-out training views
    gain by it)."""
    seed: int | None = None
    """Seeds every random choice."""
    test_every: int | None = None
    """Hold out every n-th view of each camera; 0 holds out none."""
    images: str | None = None
    """Image folder, where it is not images/ beside the model."""
    allow_missing: bool = False
    """Skip frames whose image is missing."""
    reference: Path | None = None
    """Photographs of the same views under one common exposure, to judge against."""
    known_exposures: str | None = None
    """Exposures to keep: a CSV file (image, exposure or ev), or exif."""
    known_deviation_ev: float | None = None
    """Treat them as uncertain by this many stops instead of keeping them."""
    lpips_weights: str | None = None
    """Weights of LPIPS (.npz, docs/files.md): judge with it as well."""
    resume: bool = False
    """Continue an interrupted run."""


@dataclass(frozen=True)
class Calibrate:
    """Exposures, gammas and tone curve alone, with error bars, in seconds: no splatting."""

    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, a folder of photographs, or a finished run (correspondences
    then go through its rendered depth)."""
    out: Path
    """Folder for photometry.json and calibration.png."""
    config: Annotated[configs.FitConfig, tyro.conf.arg(name="")]
    known_exposures: str | None = None
    """Exposures to keep: a CSV file (image, exposure or ev), or exif."""
    known_deviation_ev: float | None = None
    """Treat them as uncertain by this many stops instead of keeping them."""
    compare_with: str | None = None
    """Stated exposures to compare with: exif or a CSV file (default: EXIF)."""
    static: bool = False
    """A folder of photographs from one fixed viewpoint at several exposures."""
    max_width: int | None = None
    """Shrink images to at most this many pixels across."""
    images: str | None = None
    """Image folder, where it is not images/ beside the model."""


@dataclass(frozen=True)
class Render:
    """Render views of a finished run at any exposure and gamma."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    out: Path | None = None
    """Where to write (default: RUN/renders/all)."""
    split: str = "all"
    """Which views: all, train or test."""
    exposure_ev: float | None = None
    """Exposure in stops relative to the mean; default: each view's own."""
    gamma: float | None = None
    """Gamma; default: each view's own."""


@dataclass(frozen=True)
class Eval:
    """Judge a finished run again, against its photographs or a reference."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    reference: Path | None = None
    """Photographs of the same views under one common exposure."""
    lpips_weights: str | None = None
    """Weights of LPIPS (.npz, docs/files.md; none leaves it out; default: the run's)."""


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
    """speed_error, growth, memory, step, hard_cases; none named runs all."""
    out: Path = Path("runs/bench")
    """Folder for tables, JSON and plots."""
    quick: bool = False
    """Fewer and smaller: two minutes instead of half an hour."""
    baseline: Path | None = None
    """Compare speed_error with this file; exit code 1 where it is worse."""
    write_baseline: Path | None = None
    """Write what speed_error measured, for a later --baseline."""


def _preset_from(argv: list[str]) -> configs.FitConfig:
    """Return the preset that `--preset` names: its values become the defaults of all options."""
    name = "robust"
    for i, arg in enumerate(argv):
        if arg == "--preset" and i + 1 < len(argv):
            name = argv[i + 1]
        elif arg.startswith("--preset="):
            name = arg.split("=", 1)[1]
    if name not in PRESETS:
        raise UserError(f"there is no preset {name!r}.", fix=f"choose {', '.join(PRESETS)}")
    return configs.preset(name)


def _known(cfg: configs.FitConfig, args: Fit | Calibrate) -> configs.FitConfig:
    p = cfg.photometry
    if args.known_exposures is not None:
        p = dataclasses.replace(p, known=args.known_exposures)
    if args.known_deviation_ev is not None:
        p = dataclasses.replace(p, known_deviation_ev=args.known_deviation_ev)
    _check(p.known_deviation_ev >= 0, "--known-deviation-ev must be 0 or more")
    _check(
        args.known_deviation_ev is None or p.known is not None,
        "--known-deviation-ev says nothing without --known-exposures",
    )
    return dataclasses.replace(cfg, photometry=p)


def resolve_calibration(args: Calibrate) -> configs.FitConfig:
    """Return the configuration with the short options applied.

    Raises:
        UserError: a value makes no sense.
    """
    data = args.config.data
    for name in ("max_width", "images"):
        if getattr(args, name) is not None:
            data = dataclasses.replace(data, **{name: getattr(args, name)})
    _check(data.max_width is None or data.max_width >= 16, "--max-width must be at least 16")
    return _known(dataclasses.replace(args.config, data=data), args)


def resolve(args: Fit) -> configs.FitConfig:
    """Return the configuration with the short options applied.

    Raises:
        UserError: a value makes no sense.
    """
    cfg = args.config
    data, train, evaluation = cfg.data, cfg.train, cfg.evaluation
    for name in ("max_width", "test_every", "images"):
        if getattr(args, name) is not None:
            data = dataclasses.replace(data, **{name: getattr(args, name)})
    if args.allow_missing:
        data = dataclasses.replace(data, allow_missing=True)
    if args.seed is not None:
        train = dataclasses.replace(train, seed=args.seed)
    if args.steps is not None:
        train = dataclasses.replace(train, steps=args.steps)
    if args.budget is not None:
        train = dataclasses.replace(train, budget_s=parse_duration(args.budget))
    if args.lpips_weights is not None:
        evaluation = dataclasses.replace(evaluation, lpips_weights=args.lpips_weights)
    densify = cfg.densify
    if args.gaussians is not None:
        most = parse_gaussians(args.gaussians)
        densify = dataclasses.replace(densify, max_gaussians=most)
    _check(data.max_width is None or data.max_width >= 16, "--max-width must be at least 16")
    _check(data.test_every >= 0, "--test-every must be 0 or more")
    _check(train.steps >= 1, "--steps must be at least 1")
    cfg = dataclasses.replace(cfg, data=data, train=train, evaluation=evaluation, densify=densify)
    return _known(cfg, args)


def _check(condition: bool, text: str) -> None:
    if not condition:
        raise UserError(text + ".")


def _run(argv: list[str]) -> int:
    fit_default = Fit(tyro.MISSING, tyro.MISSING, _preset_from(argv))
    calibrate_default = Calibrate(tyro.MISSING, tyro.MISSING, _preset_from(argv))
    commands_union = Union[  # noqa: UP007 (annotated members cannot be joined with |)
        Annotated[Fit, tyro.conf.subcommand("fit", default=fit_default)],
        Annotated[Calibrate, tyro.conf.subcommand("calibrate", default=calibrate_default)],
        Annotated[Render, tyro.conf.subcommand("render")],
        Annotated[Eval, tyro.conf.subcommand("eval")],
        Annotated[Demo, tyro.conf.subcommand("demo")],
        Annotated[Synth, tyro.conf.subcommand("synth")],
        Annotated[Sweep, tyro.conf.subcommand("sweep")],
        Annotated[Bench, tyro.conf.subcommand("bench")],
    ]
    args: Any = tyro.cli(
        commands_union,  # pyright: ignore[reportArgumentType]
        prog="p2gs-jax",
        description="Photometrically consistent Gaussian splatting in JAX.",
        args=argv,
    )
    # Imported here so that --help answers at once.
    from p2gs_jax import commands
    from p2gs_jax.compile_cache import use_compile_cache

    use_compile_cache()
    if isinstance(args, Fit):
        return commands.fit_command(
            args.scene, args.out, resolve(args), args.reference, args.resume
        )
    if isinstance(args, Calibrate):
        return commands.calibrate_command(
            args.scene, args.out, resolve_calibration(args), args.compare_with, args.static
        )
    if isinstance(args, Render):
        return commands.render_command(args.run, args.out, args.split, args.exposure_ev, args.gamma)
    if isinstance(args, Eval):
        return commands.eval_command(args.run, args.reference, args.lpips_weights)
    if isinstance(args, Sweep):
        return commands.sweep_command(args.file, args.out, args.max_parallel)
    if isinstance(args, Synth):
        return commands.synth_command(
            args.out,
            args.sensor,
            frames=args.frames,
            width=args.width,
            layout=args.layout,
            supersample=args.supersample,
            points=args.points,
            lidar=args.lidar,
            seed=args.seed,
        )
    if isinstance(args, Bench):
        return commands.bench_command(
            args.parts, args.out, args.quick, args.baseline, args.write_baseline
        )
    return commands.demo_command(
        args.out,
        _preset_from(["--preset", args.preset]),
        budget_s=parse_duration(args.budget),
        frames=args.frames,
        width=args.width,
        iso_std=args.iso_std,
        seed=args.seed,
    )


def main(argv: list[str] | None = None) -> None:
    """Run the command line and exit.

    Codes: 0 done, 1 worse than a baseline, 2 bad input, 130 interrupted.
    """
    try:
        code = _run(sys.argv[1:] if argv is None else argv)
    except UserError as error:
        print(f"p2gs-jax: error: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("p2gs-jax: interrupted; --resume continues from the last checkpoint", file=sys.stderr)
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
