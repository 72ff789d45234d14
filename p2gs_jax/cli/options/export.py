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

Format = Literal[
    "linear-ply",
    "display-ply",
    "splat",
    "spz",
    "compressed-ply",
    "gltf",
    "usd",
    "colmap",
    "nerfstudio",
    "exr",
    "html",
]
FORMATS: tuple[Format, ...] = get_args(Format)
# The formats that hold display colours and therefore one display transform.
DISPLAY: tuple[Format, ...] = (
    "display-ply",
    "splat",
    "spz",
    "compressed-ply",
    "gltf",
    "usd",
)
# What the option --size-mb is where it is not given: a page that a mail or a wiki takes.
SIZE_MB = 20.0


@dataclass(frozen=True)
class Export:
    """Write a finished run in the formats of other programs.

    p2gs-jax export runs/street --format display-ply
    p2gs-jax export runs/street --format linear-ply colmap exr --out for_others
    p2gs-jax export runs/street --format usd exr --out for_blender
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    format: tuple[Format, ...]
    """One or more: linear-ply (radiance, with a JSON file that explains it), display-ply, splat,
    spz, compressed-ply, gltf and usd (display colours, for viewers and other programs), colmap and
    nerfstudio (undistorted photographs, model, exposures), exr (linear renders of all views), html
    (one page that is the scene: linear light, developed in the browser)."""
    out: Path | None = None
    """Folder to write into (default: RUN/exports)."""
    exposure_ev: float | None = None
    """Display colours, and what html opens with: exposure in stops relative to the mean (default:
    0)."""
    exposure_of: Literal["auto", "log_average", "centre", "highlights", "protected"] | None = None
    """The same: exposure metered in the training views, one for all: their mean of what the
    rule of `p2gs-jax render` gives; --exposure-ev then adds stops."""
    gamma: float | None = None
    """The same: gamma (default: the run's mean)."""
    curve: Literal["power", "srgb", "spline", "linear"] | None = None
    """The same: base tone curve (default: the run's)."""
    white_balance_of: str | None = None
    """The same: white balance of this view (default: neutral), where views differ in it."""
    bake_steps: int | None = None
    """Display colours: steps that bring a viewer's pictures closer to the true ones; 0 takes every
    Gaussian by itself (default: 240, or one for every training view if that is more)."""
    without_objects: bool = False
    """Leave out what moves; files of Gaussians otherwise hold it as of the middle of the drive."""
    size_mb: float | None = None
    """html: largest size of the page, millions of bytes (default: 20). What does not fit is left
    out, least visible first, and the page says what that costs."""
    photographs: int | None = None
    """html: how many photographs to embed, evenly spread, for the split view (default: none;
    whoever has the page has them, with all they show)."""
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
    size = args.size_mb
    check(size is None or (math.isfinite(size) and size > 0), "--size-mb must be positive")
    check(args.photographs is None or args.photographs >= 0, "--photographs must be 0 or more")
    look = ("exposure_ev", "exposure_of", "gamma", "curve", "white_balance_of")
    _require_a_use(args, look, (*DISPLAY, "html"), "a format that is developed")
    _require_a_use(args, ("bake_steps",), DISPLAY, "a format that holds display colours")
    _require_a_use(args, ("size_mb", "photographs"), ("html",), "the format html")


def _require_a_use(
    args: Export, names: tuple[str, ...], formats: tuple[Format, ...], what: str
) -> None:
    """Reject options that none of the requested formats heeds."""
    given = [n for n in names if getattr(args, n) is not None]
    if given and not set(args.format) & set(formats):
        which = formats[0] if len(formats) == 1 else f"one of {', '.join(formats)}"
        raise UserError(
            f"--{given[0].replace('_', '-')} says nothing without {what}.",
            fix=f"leave it out, or add {which} to --format",
        )
