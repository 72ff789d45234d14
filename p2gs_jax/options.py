"""Options of the configuration: their short names on the command line, and their valid values."""

from __future__ import annotations

import math

from p2gs_jax.config import FitConfig
from p2gs_jax.errors import UserError
from p2gs_jax.presets import flat, to_dict

# Short names of fields: the field, and the placeholder of its value. A command that has any lists
# them as `SHORT_NAMES`.
SHORT = {
    "budget": ("train.budget_s", "TIME"),
    "max_width": ("data.max_width", "N"),
    "steps": ("train.steps", "N"),
    "gaussians": ("densify.max_gaussians", "N"),
    "test_every": ("data.test_every", "N"),
    "split": ("data.split", "FILE|every"),
    "background": ("data.background", "COLOR"),
    "images": ("data.images", "DIR"),
    "camera_by": ("data.camera_by", None),
    "allow_missing": ("data.allow_missing", None),
    "drive": ("data.drive", "NAME"),
    "cameras": ("data.cameras", "NAME"),
    "frames": ("data.frames", "SLICE"),
    "every": ("data.every", "N"),
    "max_frames": ("data.max_frames", "N"),
    "known_exposures": ("photometry.known", "FILE|exif"),
    "exposure_sigma": ("photometry.known_deviation_ev", "STOPS"),
    "lpips_weights": ("evaluation.lpips_weights", "alex|vgg"),
    "seed": ("train.seed", "N"),
}
MOST_STOPS = 60.0  # largest distance of an exposure from the mean exposure
DURATIONS = "write 90s, 5m or 1h30m"
# Smallest and largest values of numbers; None: there is no bound. All others are at least 0.
TINY, NEARLY_1 = 1e-9, 1 - 1e-6
BOUNDS = {
    "data.max_width": (16, None),
    "data.every": (1, None),
    "data.max_frames": (2, None),
    "train.steps": (1, None),
    "train.batch": (1, None),
    "train.log_every": (1, None),
    "train.budget_s": (None, None),
    "train.sh_every": (TINY, None),
    "train.coarse_to_fine": (0, 1),
    "render.sh_degree": (0, 3),
    "render.tile": (1, None),
    "render.chunk": (1, None),
    "render.pixels_in_flight": (1, None),
    "init.shell_count": (1, None),
    "densify.max_gaussians": (1, None),
    "photometry.spline": (None, None),
    "photometry.pivot": (TINY, None),
    "render.near": (TINY, None),
    "render.alpha_cutoff": (0, NEARLY_1),
    "render.alpha_max": (TINY, NEARLY_1),
    "init.opacity": (TINY, NEARLY_1),
    "init.dense_opacity": (TINY, NEARLY_1),
    "loss.dssim_weight": (0, 1),
    "loss.saturation": (TINY, None),
    "optimizer.b1": (0, NEARLY_1),
    "optimizer.b2": (0, NEARLY_1),
    "dynamics.voxel": (TINY, None),
    "dynamics.most_points": (1, None),
}


def check_values(cfg: FitConfig) -> None:
    """Check each number by itself, and that a deviation comes with known exposures.

    Raises:
        UserError: a number is not finite or out of its range, or a deviation comes without them.
    """
    short = {field: name for name, (field, _) in SHORT.items()}
    for name, value in flat(to_dict(cfg)).items():
        option = f"--{short.get(name, name).replace('_', '-')}"
        least, most = BOUNDS.get(name, (0, None))
        for number in value if isinstance(value, tuple | list) else (value,):
            if not isinstance(number, int | float):
                continue
            if not math.isfinite(number):
                raise UserError(f"{option} {number} is not a finite number.")
            if least is not None and number < least:
                raise UserError(f"{option} must be at least {least}.")
            if most is not None and number > most:
                raise UserError(f"{option} must be at most {most}.")
    if list(cfg.train.coarse_to_fine) != sorted(cfg.train.coarse_to_fine):
        raise UserError(f"--train.coarse-to-fine {cfg.train.coarse_to_fine} does not increase.")
    if cfg.train.budget_s is not None and cfg.train.budget_s <= 0:
        raise UserError("--budget must be longer than 0 s.", fix=DURATIONS)
    if cfg.photometry.known_deviation_ev > 0 and cfg.photometry.known is None:
        why = "--exposure-sigma has no effect without --known-exposures."
        raise UserError(why, fix="add --known-exposures FILE, or exif")
