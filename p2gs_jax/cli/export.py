"""The command `export` and its options."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from p2gs_jax.cli.shared import MeteringRule, PhotometryFolder, RunOrSplats, SceneFolder, check
from p2gs_jax.errors import UserError

if TYPE_CHECKING:
    from p2gs_jax.photometry.display import DisplayTransform
    from p2gs_jax.run.read import Run

# The formats that hold display colours, converted from radiance by one display transform.
Display = Literal["display-ply", "spz", "compressed-ply", "gltf", "usd"]
Format = Literal["linear-ply", Display, "colmap", "nerfstudio", "exr", "html"]
FORMATS, DISPLAY = get_args(Format), get_args(Display)


@dataclass(frozen=True)
class Export:
    """Write a finished run in the formats of other programs.

    p2gs-jax export runs/street --format display-ply
    p2gs-jax export runs/street --format linear-ply colmap exr --out for_others
    p2gs-jax export runs/street --format usd exr --out for_blender
    p2gs-jax export splat.ply --photometry calibrated --scene castle --format linear-ply html
    """

    run: RunOrSplats
    format: tuple[Format, ...]
    """Formats: linear-ply (radiance); display-ply, spz, compressed-ply, gltf, usd (display
    colours); colmap, nerfstudio (photographs, model); exr (renders); html (a page to view)."""
    out: Path | None = None
    """Folder to write into (default: RUN/exports)."""
    exposure_ev: float | None = None
    """Exposure of display colours and html, stops from the mean (default: 0)."""
    meter: MeteringRule | None = None
    """Rule (as in `render`) that meters the training views; --exposure-ev adds stops."""
    gamma: float | None = None
    """Gamma of display colours and html (default: the run's mean)."""
    curve: Literal["power", "srgb", "spline", "linear"] | None = None
    """Tone curve of display colours and html (default: the run's)."""
    white_balance_of: str | None = None
    """View that gives display colours and html their white balance (default: neutral)."""
    bake_steps: int | None = None
    """Number of steps that bring display colours closer to the true pictures (default: 240, or the
    number of training views if larger); 0: none. With --photometry they also refine radiance."""
    without_objects: bool = False
    """Leave out moving objects; else Gaussians and html show them at mid-drive."""
    size_mb: float | None = None
    """Largest size of the html page, MB (default: 20); the least visible Gaussians are left out."""
    photographs: int | None = None
    """Number of photographs that the html page embeds (default: 0); readers can copy them."""
    scene: SceneFolder = None
    photometry: PhotometryFolder = None
    overwrite: bool = False
    """Replace the files of an earlier export."""

    def execute(self) -> int:
        """Write every requested format."""
        from p2gs_jax.core.progress import PlainConsole, TerminalReporter
        from p2gs_jax.export.convert import STEPS, convert, require_packages
        from p2gs_jax.run.foreign import ForeignRun, load_run_or_splats

        check_export(self)
        require_packages(self.format)
        fitted = load_run_or_splats(self.run, self.scene, self.photometry)
        if self.without_objects:
            fitted = fitted.without_objects()
        with TerminalReporter() as reporter:
            if isinstance(fitted, ForeignRun) and {"linear-ply", "html", *DISPLAY} & set(
                self.format
            ):
                steps = STEPS if self.bake_steps is None else self.bake_steps
                fitted = fitted.refined(steps, lambda i, n: reporter.stage("Lifting", i, n))
            for note in fitted.notes:
                reporter.message(note)
            if fitted.cfg.render.background is not None and {"html", *DISPLAY} & set(self.format):
                reporter.message("Exported Gaussians have no background, so it is black.")
            written = convert(
                fitted,
                tuple(dict.fromkeys(self.format)),
                self.out or fitted.folder / "exports",
                display_transform(fitted, self),
                bake_steps=self.bake_steps,
                page_mb=20.0 if self.size_mb is None else self.size_mb,
                page_photographs=self.photographs or 0,
                overwrite=self.overwrite,
                reporter=reporter,
            )
            for path, text, seconds in written:
                PlainConsole().print(f"{path}: {text} ({seconds:.1f} s)", soft_wrap=True)
        return 0


def display_transform(fitted: Run, options: Export) -> DisplayTransform:
    """Return the chosen transform; UserError: the run lacks the curve, rule or white balance."""
    ev = options.exposure_ev or 0.0
    transform = fitted.common_display(ev)
    if options.meter is not None:
        typical = fitted.metering.typical_exposure(options.meter)
        transform = replace(transform, exposure=typical * 2**ev)
    if options.white_balance_of is not None:
        balance = fitted.white_balance_of(options.white_balance_of)
        transform = replace(transform, white_balance=balance)
    if options.gamma is not None:
        transform = replace(transform, gamma=options.gamma)
    return transform if options.curve is None else transform.with_curve(options.curve)


def check_export(args: Export) -> None:
    """Raise a UserError for values out of range and options without effect."""
    from p2gs_jax.options import MOST_STOPS

    ev, gamma, size = args.exposure_ev, args.gamma, args.size_mb
    check(bool(args.format), "--format needs a format", fix=f"choose from {', '.join(FORMATS)}")
    why = f"--exposure-ev must be from {-MOST_STOPS:g} to {MOST_STOPS:g} stops"
    check(ev is None or abs(ev) <= MOST_STOPS, why)
    check(gamma is None or (math.isfinite(gamma) and gamma > 0), "--gamma must be positive")
    check(args.bake_steps is None or args.bake_steps >= 0, "--bake-steps must be at least 0")
    check(size is None or (math.isfinite(size) and size > 0), "--size-mb must be positive")
    check(args.photographs is None or args.photographs >= 0, "--photographs must be at least 0")
    look = ("exposure_ev", "meter", "gamma", "curve", "white_balance_of")
    for names, formats, needed in (
        (look, (*DISPLAY, "html"), "a format of display colours, or html"),
        (("bake_steps",), FORMATS if args.photometry else DISPLAY, "a format of display colours"),
        (("size_mb", "photographs"), ("html",), "the format html"),
    ):
        used = [n for n in names if getattr(args, n) is not None]
        if used and not set(args.format) & set(formats):
            fix = f"leave it out, or add one of these to --format: {', '.join(formats)}"
            name = used[0].replace("_", "-")
            raise UserError(f"--{name} has no effect without {needed}.", fix=fix)
