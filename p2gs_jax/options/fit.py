"""`fit` and `calibrate`: from photographs to a run folder, or to exposures alone."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_args

import tyro

from p2gs_jax import config as configs
from p2gs_jax.errors import UserError
from p2gs_jax.options.parse import check, parse_duration, parse_gaussians

PRESETS: tuple[configs.PresetName, ...] = get_args(configs.PresetName)


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


def resolve_calibration(args: Calibrate) -> configs.FitConfig:
    """Return the configuration with the short options applied.

    Raises:
        UserError: a value makes no sense.
    """
    data = args.config.data
    for name in ("max_width", "images"):
        if getattr(args, name) is not None:
            data = dataclasses.replace(data, **{name: getattr(args, name)})
    check(data.max_width is None or data.max_width >= 16, "--max-width must be at least 16")
    return _known(dataclasses.replace(args.config, data=data), args)


def resolve_fit(args: Fit) -> configs.FitConfig:
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
    check(data.max_width is None or data.max_width >= 16, "--max-width must be at least 16")
    check(data.test_every >= 0, "--test-every must be 0 or more")
    check(train.steps >= 1, "--steps must be at least 1")
    cfg = dataclasses.replace(cfg, data=data, train=train, evaluation=evaluation, densify=densify)
    return _known(cfg, args)


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
    )
    return dataclasses.replace(cfg, photometry=p)


def named_preset(name: str) -> configs.FitConfig:
    """Return a preset.

    Raises:
        UserError: there is none of that name.
    """
    if name not in PRESETS:
        raise UserError(f"there is no preset {name!r}.", fix=f"choose {', '.join(PRESETS)}")
    return configs.preset(name)
