"""`fit` and `calibrate`: from photographs to a run folder, or to exposures alone."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from p2gs_jax import config as configs
from p2gs_jax.cli.options.parse import check, parse_duration, parse_gaussians

Preset = Annotated[configs.PresetName, tyro.conf.arg(metavar="NAME")]
Duration = Annotated[str | None, tyro.conf.arg(metavar="TIME")]
Count = Annotated[str | None, tyro.conf.arg(metavar="N")]
Exposures = Annotated[str | None, tyro.conf.arg(metavar="FILE|exif")]
Weights = Annotated[str | None, tyro.conf.arg(metavar="alex|vgg|FILE")]
Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
Drive = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
Cameras = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")]
Frames = Annotated[str | None, tyro.conf.arg(metavar="SLICE")]
Deviation = Annotated[float | None, tyro.conf.arg(metavar="STOPS")]


@dataclass(frozen=True)
class Fit:
    """Fit linear HDR radiance, exposures and gammas to photographs.

    Writes a run folder; open its summary.png first. An interrupted run goes on with --resume.

        p2gs-jax fit castle --out runs/castle --max-width 960 --budget 20m
        p2gs-jax fit castle --out runs/castle --resume
        p2gs-jax fit castle --out runs/paper --preset paper --steps 7000
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, Blender's or LLFF's folder, a rig, a drive of a data set
    (PandaSet, nuScenes, ...), a folder of photographs, or a video (docs/scenes.md)."""
    out: Folder
    """Run folder to create."""
    config: Annotated[configs.FitConfig, tyro.conf.arg(name="")]
    budget: Duration = None
    """Wall-clock limit for the whole run: 90s, 20m or 1h30m; replaces --steps."""
    max_width: int | None = None
    """Shrink images to at most this many pixels across; default: as they are."""
    resume: bool = False
    """Continue an interrupted run; give the options it was started with."""
    preset: Preset = "robust"
    """Where all values start: robust; the method as printed, paper or paper_appendix; baselines
    3dgs (3dgs_published: as printed, 30000 steps), 3dgs_gain, 3dgs_affine, 3dgs_bilateral,
    3dgs_curve, luminance_gs or ppisp; or ppisp_solved."""
    steps: int | None = None
    """Optimisation steps, one view each; default: the preset's (robust 2000, paper 30000)."""
    gaussians: Count = None
    """Upper bound on the Gaussians; default: from the seeds and the pixels."""
    test_every: int | None = None
    """Hold out every n-th view of each camera for evaluation; 0 holds out none; default: 8, or as
    the data set says."""
    split: Annotated[str | None, tyro.conf.arg(metavar="FILE|every")] = None
    """Names of the held-out photographs, a line each, or a .json with the lists train and test;
    every: by --test-every though the data set says otherwise (docs/scenes.md)."""
    background: Annotated[str | None, tyro.conf.arg(metavar="COLOR")] = None
    """What photographs with alpha and their renders are put over: white, black, random (another for
    every step) or R,G,B from 0 to 1; default: white."""
    images: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None
    """Image folder, where it is not images/ beside the model."""
    allow_missing: bool = False
    """Skip frames whose image is missing."""
    drive: Drive = None
    """Which drive, where the folder holds several: its name, or how that begins."""
    cameras: Cameras = ()
    """Only these cameras of a drive: front, back_left, ...; default: all."""
    frames: Frames = None
    """Only these frames of a drive: FIRST:END or FIRST:END:STEP; default: all."""
    every: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Take every N-th frame of a video; default: sharp ones, each from a new place."""
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Most frames of a video that are used; default: 150."""
    known_exposures: Exposures = None
    """Exposures to keep: a CSV file (image, exposure or ev), or exif."""
    known_deviation_ev: Deviation = None
    """Treat known exposures as uncertain by this many stops instead of keeping them."""
    reference: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Photographs of the same views under one common exposure, for evaluation."""
    blocks: Annotated[str | None, tyro.conf.arg(metavar="N|auto")] = None
    """Cut the scene into N blocks that are fitted apart and merged; auto: into as few as memory
    allows (docs/districts.md). Default: one fit."""
    jobs: int = 1
    """Blocks at a time on this machine."""
    engine: Annotated[str, tyro.conf.arg(metavar="NAME")] = "local"
    """Where blocks are fitted: local, dask://HOST:PORT, or slurm:OPTION=VALUE,...
    (docs/sweeps.md)."""
    lpips_weights: Weights = None
    """Evaluate with LPIPS too: alex or vgg (pip install 'p2gs-jax[lpips]'), or a .npz of
    weights."""
    seed: int | None = None
    """Seeds every random choice; default: 0."""
    devices: Annotated[str, tyro.conf.arg(metavar="N|all")] = "1"
    """Devices of a step, each with its own views (--train.batch; default then: one view each)."""


@dataclass(frozen=True)
class Calibrate:
    """Solve exposures, gammas and tone curve alone, in seconds.

    From the colours of shared points, without splatting, and with standard errors. Prints a table
    and writes photometry.json; open calibration.png first.

        p2gs-jax calibrate castle --out photometry
        p2gs-jax calibrate castle --out photometry --known-exposures exif
        p2gs-jax calibrate stack --out photometry --static
        p2gs-jax calibrate castle --out runs/relit --of splats.ply
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """COLMAP model, transforms.json, a rig, a folder of photographs, a video (docs/scenes.md), or a
    finished run (correspondences then go through its rendered depth)."""
    out: Folder
    """Folder for photometry.json and calibration.png."""
    config: Annotated[configs.FitConfig, tyro.conf.arg(name="")]
    max_width: int | None = None
    """Shrink images to at most this many pixels across; default: as they are."""
    known_exposures: Exposures = None
    """Exposures to keep: a CSV file (image, exposure or ev), or exif."""
    known_deviation_ev: Deviation = None
    """Treat known exposures as uncertain by this many stops instead of keeping them."""
    compare_with: Exposures = None
    """Stated exposures to compare with; default: EXIF."""
    static: bool = False
    """The folder holds photographs from one fixed viewpoint at several exposures."""
    of: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Somebody's splats of the scene (.ply, .splat, .spz; display colours): exposures are
    solved, and it is written as linear radiance into --out, a run folder."""
    steps: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With --of: steps in which its colours and opacities are fitted again; default: 600."""
    images: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None
    """Image folder, where it is not images/ beside the model."""
    drive: Drive = None
    """Which drive, where the folder holds several: its name, or how that begins."""
    cameras: Cameras = ()
    """Only these cameras of a drive: front, back_left, ...; default: all."""
    frames: Frames = None
    """Only these frames of a drive: FIRST:END or FIRST:END:STEP; default: all."""
    every: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Take every N-th frame of a video; default: sharp ones, each from a new place."""
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Most frames of a video that are used; default: 150."""
    preset: Preset = "robust"
    """Where all values start; see `fit`."""


def resolve_blocks(args: Fit) -> int | str | None:
    """Return how many blocks are asked for: a number, `auto`, or None for one fit.

    Raises:
        UserError: it is neither, or options of blocks are given without them.
    """
    words = args.blocks
    if words is None:
        check(
            args.jobs == 1 and args.engine == "local",
            "--jobs and --engine are of blocks",
            fix="add --blocks auto, or a number",
        )
        return None
    check(args.jobs >= 1, "--jobs must be at least 1")
    check(
        args.devices == "1",
        "--blocks fits every block on one device",
        fix="leave out --devices; blocks have --jobs and --engine",
    )
    check(
        words == "auto" or (words.isdigit() and int(words) >= 1),
        f"--blocks {words!r} is no number of blocks",
        fix="write a whole number from 1 on, or auto",
    )
    return words if words == "auto" else int(words)


def resolve_calibration(args: Calibrate) -> configs.FitConfig:
    """Return the configuration with the short options applied.

    Raises:
        UserError: a value makes no sense.
    """
    data = args.config.data
    for name in ("max_width", "images", "drive", "frames", "every", "max_frames"):
        if getattr(args, name) is not None:
            data = dataclasses.replace(data, **{name: getattr(args, name)})
    if args.cameras:
        data = dataclasses.replace(data, cameras=args.cameras)
    check(
        not (args.static and args.of), "--static and --of exclude each other", fix="leave one out"
    )
    check(args.steps is None or args.of is not None, "--steps says nothing without --of")
    check(args.steps is None or args.steps >= 1, "--steps must be at least 1")
    check(data.max_width is None or data.max_width >= 16, "--max-width must be at least 16")
    check(data.every is None or data.every >= 1, "--every must be at least 1")
    check(data.max_frames >= 2, "--max-frames must be at least 2")
    return _known(dataclasses.replace(args.config, data=data), args)


def resolve_fit(args: Fit) -> configs.FitConfig:
    """Return the configuration with the short options applied.

    Raises:
        UserError: a value makes no sense.
    """
    cfg = args.config
    data, train, evaluation = cfg.data, cfg.train, cfg.evaluation
    fields = ("max_width", "test_every", "split", "background", "images", "drive", "frames")
    for name in (*fields, "every", "max_frames"):
        if getattr(args, name) is not None:
            data = dataclasses.replace(data, **{name: getattr(args, name)})
    if args.cameras:
        data = dataclasses.replace(data, cameras=args.cameras)
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
    check(data.max_width is None or data.max_width >= 16, "--max-width must be at least 16")
    check(data.every is None or data.every >= 1, "--every must be at least 1")
    check(data.max_frames >= 2, "--max-frames must be at least 2")
    check(data.test_every >= 0, "--test-every must be 0 or more")
    check(train.steps >= 1, "--steps must be at least 1")
    check(train.batch >= 1, "--train.batch must be at least 1")
    behind = cfg.render.background or (0.0,)
    check(
        all(math.isfinite(x) and x >= 0 for x in behind),
        "--render.background must be linear radiance, three numbers that are not negative",
    )
    cfg = dataclasses.replace(cfg, data=data, train=train, evaluation=evaluation, densify=densify)
    return _known(cfg, args)


def resolve_devices(args: Fit) -> int | Literal["all"]:
    """Return the number of devices of a fit, or `all`.

    Raises:
        UserError: it is neither.
    """
    if args.devices == "all":
        return "all"
    check(
        args.devices.isdecimal() and int(args.devices) >= 1,
        f"--devices {args.devices} is not a number of devices",
        fix="give 1 or more, or all",
    )
    return int(args.devices)


def _known(cfg: configs.FitConfig, args: Fit | Calibrate) -> configs.FitConfig:
    p = cfg.photometry
    if args.known_exposures is not None:
        p = dataclasses.replace(p, known=args.known_exposures)
    if args.known_deviation_ev is not None:
        p = dataclasses.replace(p, known_deviation_ev=args.known_deviation_ev)
    check(p.known_deviation_ev >= 0, "--known-deviation-ev must be 0 or more")
    check(
        args.known_deviation_ev is None or p.known is not None,
        "--known-deviation-ev says nothing without --known-exposures",
        fix="add --known-exposures FILE, or exif",
    )
    return dataclasses.replace(cfg, photometry=p)


def named_preset(name: str) -> configs.FitConfig:
    """Return a preset.

    Raises:
        UserError: there is none of that name.
    """
    return configs.preset(name)  # pyright: ignore[reportArgumentType]
