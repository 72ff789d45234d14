"""`scene`: what there is to fit."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.cli.options.fit import Cameras, Drive, Frames
from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError

Picture = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]


@dataclass(frozen=True)
class Survey:
    """Say what a folder holds, without fitting: cameras, frames, LiDAR, boxes, what is missing.

    Of every format that can be fitted. Structure from motion is not started.

        p2gs-jax scene drive
        p2gs-jax scene drive --cameras front front_left --frames 0:40 --out plan.png
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """What a fit could be given."""
    out: Picture = None
    """Draw the scene from above into this PNG: cameras and what they see, points, boxes."""
    drive: Drive = None
    """Which drive, where the folder holds several: its name, or how that begins."""
    cameras: Cameras = ()
    """Only these cameras of a drive: front, back_left, ...; default: all."""
    frames: Frames = None
    """Only these frames of a drive: FIRST:END or FIRST:END:STEP; default: all."""
    data: DataConfig = field(default_factory=DataConfig)


def resolve_survey(args: Survey) -> DataConfig:
    """Return which photographs are meant.

    Raises:
        UserError: a value makes no sense.
    """
    if args.out is not None and args.out.suffix.lower() != ".png":
        raise UserError(f"--out {args.out}: only PNG is drawn.", fix="name it NAME.png")
    data = args.data
    for name in ("drive", "frames"):
        if getattr(args, name) is not None:
            data = dataclasses.replace(data, **{name: getattr(args, name)})
    return dataclasses.replace(data, cameras=args.cameras) if args.cameras else data
