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
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from judging import measured

import p2gs_jax
from p2gs_jax.cli.shared import parse_duration
from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json, write_text

DEPTH_WEIGHT = 0.1
METHOD = "exposure_fitted"
COLUMNS = (
    *("variant", "whole, dB", "static, dB", "moving, dB", "SSIM", "depth error, m"),
    *("depth within 10 %", "Gaussians", "steps", "seconds"),
)


def _dynamics(cfg: FitConfig, method: Any) -> FitConfig:
    return dataclasses.replace(cfg, dynamics=dataclasses.replace(cfg.dynamics, method=method))


def _no_lidar(cfg: FitConfig) -> FitConfig:
    return dataclasses.replace(cfg, data=dataclasses.replace(cfg.data, lidar=False))


def _depth(cfg: FitConfig) -> FitConfig:
    return dataclasses.replace(cfg, loss=dataclasses.replace(cfg.loss, lidar=DEPTH_WEIGHT))


OF_ROBUST: dict[str, Callable[[FitConfig], FitConfig]] = {
    "mask": lambda cfg: _dynamics(cfg, "mask"),
    "off": lambda cfg: _dynamics(cfg, "off"),
    "vibration": lambda cfg: _dynamics(cfg, "vibration"),
    "no_lidar": _no_lidar,
    "depth": _depth,
}
PRESETS = ("robust", "3dgs", "3dgs_affine", "ppisp")


def variant(name: str, args: argparse.Namespace) -> FitConfig:
    """Return the configuration of a variant under the common options."""
    preset: Any = "robust" if name in OF_ROBUST else name
    cfg = OF_ROBUST.get(name, lambda cfg: cfg)(p2gs_jax.preset(preset))
    data = dataclasses.replace(
        cfg.data, max_width=args.max_width, frames=args.frames, cameras=tuple(args.cameras)
    )
    train = dataclasses.replace(cfg.train, steps=args.steps)
    if args.budget:
        train = dataclasses.replace(train, budget_s=parse_duration(args.budget))
    if args.given and cfg.photometry.select:
        cfg = dataclasses.replace(
            cfg,
            photometry=dataclasses.replace(
                cfg.photometry,
                select=False,
                model="view_exposure",
                curve="power",
                white_balance="camera",
                vignetting="camera",
            ),
        )
    return dataclasses.replace(cfg, data=data, train=train)


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


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """Return the table of a drive."""
    digits = {"whole": 2, "static": 2, "moving": 2, "ssim": 3, "depth_m": 2, "depth_within": 2}
    digits |= {"gaussians": 0, "steps": 0, "seconds": 0}
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---|" + "---:|" * (len(COLUMNS) - 1)]
    for row in rows:
        if "failed" in row:
            lines.append(f"| {row['method']} | failed: {row['failed']} |" + " |" * len(digits))
            continue
        cells = ["" if row[k] is None else f"{row[k]:.{d}f}" for k, d in digits.items()]
        lines.append("| " + " | ".join([row["method"], *cells]) + " |")
    return "\n".join(lines) + "\n"


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
    text = to_markdown(rows)
    print(text, flush=True)
    write_json(args.out / "real_drive.json", rows)
    write_text(args.out / "real_drive.md", text)


if __name__ == "__main__":
    main()
