"""`export`: a finished run in the formats of other programs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from p2gs_jax.cli.shared import MeteringRule, RunPath, SceneFolder, check
from p2gs_jax.errors import UserError

if TYPE_CHECKING:
    from p2gs_jax.photometry.display import DisplayTransform
    from p2gs_jax.run.read import Run

# The formats that hold display colours and therefore one display transform.
Display = Literal["display-ply", "spz", "compressed-ply", "gltf", "usd"]
Format = Literal["linear-ply", Display, "colmap", "nerfstudio", "exr", "html"]
FORMATS, DISPLAY = get_args(Format), get_args(Display)


@dataclass(frozen=True)
class Export:
    """Write a finished run in the formats of other programs.

    p2gs-jax export runs/street --format display-ply
    p2gs-jax export runs/street --format linear-ply colmap exr --out for_others
    p2gs-jax export runs/street --format usd exr --out for_blender
    """

    run: RunPath
    format: tuple[Format, ...]
    """One or more: linear-ply (radiance, with a JSON file that explains it), display-ply, spz,
    compressed-ply, gltf and usd (display colours, for viewers and other programs), colmap and
    nerfstudio (undistorted photographs, model, exposures), exr (linear renders of all views), html
    (one page that is the scene: linear light, developed in the browser)."""
    out: Path | None = None
    """Folder to write into (default: RUN/exports)."""
    exposure_ev: float | None = None
    """Display colours, and what html opens with: exposure in stops relative to the mean (default:
    0)."""
    exposure_of: MeteringRule | None = None
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
    overwrite: bool = False
    """Replace what an earlier export wrote."""

    def execute(self) -> int:
        """Write every requested format."""
        from p2gs_jax.cli.tables import stdout
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.export.convert import convert, require_packages
        from p2gs_jax.run.read import load_run

        check_export(self)
        require_packages(self.format)
        fitted = load_run(self.run, self.scene)
        if self.without_objects:
            fitted = fitted.without_objects()
        with TerminalReporter() as reporter:
            if fitted.cfg.render.background is not None and {"html", *DISPLAY} & set(self.format):
                reporter.message("Formats of splats have no radiance behind them: black there.")
            written = convert(
                fitted,
                tuple(dict.fromkeys(self.format)),
                self.out or self.run / "exports",
                display_transform(fitted, self),
                bake_steps=self.bake_steps,
                page_mb=20.0 if self.size_mb is None else self.size_mb,
                page_photographs=self.photographs or 0,
                overwrite=self.overwrite,
                reporter=reporter,
            )
            for path, text, seconds in written:
                stdout().print(f"{path}: {text} ({seconds:.1f} s)", soft_wrap=True)
        return 0


def display_transform(fitted: Run, options: Export) -> DisplayTransform:
    """Return the display transform; UserError: the run has no such curve or white balance."""
    ev = options.exposure_ev or 0.0
    transform = fitted.common_display(ev)
    if options.exposure_of is not None:
        typical = fitted.metering.typical_exposure(options.exposure_of)
        transform = replace(transform, exposure=typical * 2**ev)
    if options.white_balance_of is not None:
        balance = fitted.white_balance_of(options.white_balance_of)
        transform = replace(transform, white_balance=balance)
    if options.gamma is not None:
        transform = replace(transform, gamma=options.gamma)
    return transform if options.curve is None else transform.with_curve(options.curve)


def check_export(args: Export) -> None:
    """Raise a UserError for values that make no sense."""
    ev, gamma, size = args.exposure_ev, args.gamma, args.size_mb
    check(bool(args.format), "--format names nothing", fix=f"choose from {', '.join(FORMATS)}")
    check(ev is None or abs(ev) <= 32, "--exposure-ev must be a number of stops from -32 to 32")
    check(gamma is None or (math.isfinite(gamma) and gamma > 0), "--gamma must be positive")
    check(args.bake_steps is None or args.bake_steps >= 0, "--bake-steps must be 0 or more")
    check(size is None or (math.isfinite(size) and size > 0), "--size-mb must be positive")
    check(args.photographs is None or args.photographs >= 0, "--photographs must be 0 or more")
    look = ("exposure_ev", "exposure_of", "gamma", "curve", "white_balance_of")
    for names, formats, what in (
        (look, (*DISPLAY, "html"), "a format that is developed"),
        (("bake_steps",), DISPLAY, "a format that holds display colours"),
        (("size_mb", "photographs"), ("html",), "the format html"),
    ):
        given = [n for n in names if getattr(args, n) is not None]
        if given and not set(args.format) & set(formats):
            which = formats[0] if len(formats) == 1 else f"one of {', '.join(formats)}"
            fix = f"leave it out, or add {which} to --format"
            raise UserError(f"--{given[0].replace('_', '-')} says nothing without {what}.", fix=fix)
