"""A real drive under every variant: moving things, laser points, and what photometry is worth.

python experiments/real_drive.py DRIVE --out DIR [--variants robust mask] [--max-width 480]
    [--steps 1000 | --budget 10m]

Variants: presets (`robust`, `3dgs`, `3dgs_affine`, `ppisp`) with moving things as rigid nodes; and
of `robust`: `mask` (their pixels are left out), `off` (nothing is known of them), `vibration` (no
boxes: Gaussians come, move and go), `no_lidar` (seeds are triangulated), `depth` (a loss on depth
at laser points). Columns: PSNR of held-out views (every 8th frame of all cameras) over the whole
image, over what stands still and over what moves, with one exposure fitted to each; depth of what
stands against the nearest sweep.

Photographs of such sets are not for this project: keep --out outside of it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from judging import measured, to_markdown

import p2gs_jax
from p2gs_jax.cli.shared import parse_duration
from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json, write_text

DEPTH_WEIGHT = 0.1
METHOD = "exposure_fitted"
COLUMNS = (
    ("whole, dB", "whole", 2),
    ("static, dB", "static", 2),
    ("moving, dB", "moving", 2),
    ("SSIM", "ssim", 3),
    ("depth error, m", "depth_m", 2),
    ("depth within 10 %", "depth_within", 2),
    ("Gaussians", "gaussians", 0),
    ("steps", "steps", 0),
    ("seconds", "seconds", 0),
)


# What variants change of `robust`.
OF_ROBUST: dict[str, dict[str, Any]] = {
    "mask": {"dynamics.method": "mask"},
    "off": {"dynamics.method": "off"},
    "vibration": {"dynamics.method": "vibration"},
    "no_lidar": {"data.lidar": False},
    "depth": {"loss.lidar": DEPTH_WEIGHT},
}
GIVEN = {
    "photometry.select": False,
    "photometry.model": "view_exposure",
    "photometry.curve": "power",
    "photometry.white_balance": "camera",
    "photometry.vignetting": "camera",
}
PRESETS = ("robust", "3dgs", "3dgs_affine", "ppisp")


def variant(name: str, args: argparse.Namespace) -> FitConfig:
    """Return the configuration of a variant under the common options."""
    preset: Any = "robust" if name in OF_ROBUST else name
    cfg = p2gs_jax.preset(preset)
    fields = {
        "data.max_width": args.max_width,
        "data.frames": args.frames,
        "data.cameras": tuple(args.cameras),
        "train.steps": args.steps,
        "train.budget_s": parse_duration(args.budget) if args.budget else None,
        **(GIVEN if args.given and cfg.photometry.select else {}),
        **OF_ROBUST.get(name, {}),
    }
    return p2gs_jax.with_fields(cfg, fields)


def judge(name: str, run: p2gs_jax.Run, metrics: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of a finished run."""
    scores = metrics["test"][METHOD]
    depth = metrics.get("depth", {}).get("held_out", {}).get("static", {})
    return {
        "whole": scores.get("whole", scores).get("psnr"),
        "static": scores.get("static", {}).get("psnr"),
        "moving": scores.get("moving", {}).get("psnr"),
        "ssim": scores.get("whole", scores).get("ssim"),
        "depth_m": depth.get("median_m"),
        "depth_within": depth.get("within_10_percent"),
        "gaussians": metrics["counts"]["gaussians"],
        "steps": metrics["counts"]["steps"],
        "seconds": metrics["seconds"]["optimisation"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--variants", nargs="+", default=[*PRESETS, *OF_ROBUST])
    parser.add_argument("--cameras", nargs="+", default=[])
    parser.add_argument("--frames")
    parser.add_argument("--max-width", type=int, default=480)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--budget", help="equal time in place of equal steps: 10m")
    parser.add_argument(
        "--given",
        action="store_true",
        help="an exposure per view, white balance and vignetting per camera under a power curve, "
        "as is chosen for PandaSet 002, in place of a choice by every variant",
    )
    args = parser.parse_args()
    if args.out.resolve().is_relative_to(Path(__file__).resolve().parents[1]):
        raise SystemExit("--out is inside this project, where no picture of a data set may be.")
    under = {name: variant(name, args) for name in args.variants}
    rows = measured(args.drive, args.out / "runs", under, judge)
    text = to_markdown(rows, COLUMNS)
    print(text, flush=True)
    write_json(args.out / "real_drive.json", rows)
    write_text(args.out / "real_drive.md", text)


if __name__ == "__main__":
    main()
