"""`export`: a finished run in the formats of other programs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from p2gs_jax.cli.options.parse import check
from p2gs_jax.cli.options.scene import SceneFolder
from p2gs_jax.errors import UserError

Format = Literal["linear-ply", "display-ply", "splat", "spz", "colmap", "exr", "drive"]
FORMATS: tuple[Format, ...] = get_args(Format)
# The formats that hold display colours and therefore one display transform.
DISPLAY: tuple[Format, ...] = ("display-ply", "splat", "spz")


@dataclass(frozen=True)
class Export:
    """Write a finished run in the formats of other programs.

    p2gs-jax export runs/street --format display-ply
    p2gs-jax export runs/street --format linear-ply colmap exr --out for_others
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    format: tuple[Format, ...]
    """One or more: linear-ply (radiance, with a JSON file that explains it), display-ply, splat and
    spz (display colours, for viewers), colmap (undistorted photographs, model, exposures), exr
    (linear renders of all views), drive (CSV and JSON: poses in the data set's world, exposures
    with errors)."""
    out: Path | None = None
    """Folder to write into (default: RUN/exports)."""
    exposure_ev: float | None = None
    """Display colours: exposure in stops relative to the mean (default: 0)."""
    exposure_of: Literal["auto", "log_average", "centre", "highlights", "protected"] | None = None
    """Display colours: exposure metered in the training views, one for all: their mean of what the
    rule of `p2gs-jax render` gives; --exposure-ev then adds stops."""
    gamma: float | None = None
    """Display colours: gamma (default: the run's mean)."""
    curve: Literal["power", "srgb", "spline", "linear"] | None = None
    """Display colours: base tone curve (default: the run's)."""
    white_balance_of: str | None = None
    """Display colours: white balance of this view (default: neutral), where views differ in it."""
    bake_steps: int | None = None
    """Display colours: steps that bring a viewer's pictures closer to the true ones; 0 takes every
    Gaussian by itself (default: 240, or one for every training view if that is more)."""
    without_objects: bool = False
    """Leave out what moves; files of Gaussians otherwise hold it as of the middle of the drive."""
    scene: SceneFolder = None
    """Where the run's scene lies now, if it is not where it was."""
    overwrite: bool = False
    """Replace what an earlier export wrote."""


def check_export(args: Export) -> None:
    """Reject values that make no sense.

    Raises:
        UserError: one does not.
    """
    if not args.format:
        raise UserError("--format names nothing.", fix=f"choose from {', '.join(FORMATS)}")
    ev = args.exposure_ev
    check(ev is None or abs(ev) <= 32, "--exposure-ev must be a number of stops from -32 to 32")
    gamma = args.gamma
    check(gamma is None or (math.isfinite(gamma) and gamma > 0), "--gamma must be positive")
    check(args.bake_steps is None or args.bake_steps >= 0, "--bake-steps must be 0 or more")
    display = ("exposure_ev", "exposure_of", "gamma", "curve", "white_balance_of", "bake_steps")
    given = [n for n in display if getattr(args, n) is not None]
    if given and not set(args.format) & set(DISPLAY):
        raise UserError(
            f"--{given[0].replace('_', '-')} says nothing without a format that holds display "
            "colours.",
            fix=f"leave it out, or add one of {', '.join(DISPLAY)} to --format",
        )
