"""Views a step against held-out PSNR, with learning rates by the root of their number and without.

    python experiments/batch_rule.py --out runs/batch_rule --rows 1 4 4-plain

Every row sees as many photographs. Rows that are there are only printed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from p2gs_jax.config import FitConfig
from p2gs_jax.core.compile_cache import use_compile_cache
from p2gs_jax.core.runtime import tune_process
from p2gs_jax.pipeline.fit import fit
from p2gs_jax.run.folder import (
    RunFolder,
)
from p2gs_jax.sweep import with_fields
from p2gs_jax.synth.write import write_street

RATES = (
    *("means", "means_final", "sh_dc", "sh_rest", "opacities", "scales", "quats"),
    *("exposures", "gammas"),
)


def configured(row: str, steps: int) -> FitConfig:
    """Return the options of a row: views a step, `-plain` for rates as those of one view."""
    views, _, plain = row.partition("-")
    fields = {"train.steps": steps, "train.batch": int(views), "train.coarse_to_fine": ()}
    cfg = with_fields(FitConfig(), fields)
    if not plain:
        return cfg
    rule = int(views) ** 0.5
    return with_fields(
        cfg, {f"optimizer.{name}": getattr(cfg.optimizer, name) / rule for name in RATES}
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rows", nargs="+", default=("1", "4", "4-plain"), metavar="VIEWS[-plain]")
    parser.add_argument("--steps", type=int, default=600)
    args = parser.parse_args()
    use_compile_cache()
    tune_process()
    scene = args.out / "street"
    if not scene.exists():
        write_street(scene, frames=6, width=192, height=128, points=6000)
    print("| views a step | held out, dB | training, dB | s of steps |\n|---|---|---|---|")
    for row in args.rows:
        run = args.out / row
        if not RunFolder(run).metrics.exists():
            # One that was interrupted goes on.
            begun = RunFolder(run).config.exists()
            fit(scene, run, configured(row, args.steps), resume=begun)
        found = json.loads(RunFolder(run).metrics.read_text())
        test, train = found["test"], found["train"]
        print(
            f"| {row} | {test['exposure_fitted']['psnr']:.2f} | {train['psnr']:.2f} | "
            f"{found['seconds']['steps']:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
