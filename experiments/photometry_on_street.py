"""Every formulation of the photometry on full reconstructions of streets with known exposures.

python experiments/photometry_on_street.py --out runs/photometry --steps 600 --seeds 0 1 2

Streets of ISO std 2 and 4. Fixed steps, so that the load of the machine does not matter. Finished
fits are kept: run it again to continue. Columns: exposure error in stops after scale alignment (EV)
and after scale and power (EVp), radiance error in stops (RMS, unsaturated pixels), and PSNR against
photographs at ISO 8, of all views (scale aligned) and of held-out views.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np

import p2gs_jax
from p2gs_jax.config import FitConfig
from p2gs_jax.pipeline.decide import without_tracks
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.sweep.rows import read_row

# Name of the column, column of a sweep's table.
COLUMNS = {
    "gaussians": "gaussians",
    "seconds": "seconds",
    "ev": "ev",
    "ev_power": "ev_power",
    "stops": "radiance_stops",
    "training": "train_psnr",
    "iso8": "reference_psnr",
    "iso8_held_out": "reference_test_psnr",
}
FORMATS = {"ev": ".3f", "ev_power": ".3f", "stops": ".3f", "gaussians": ".0f", "seconds": ".0f"}


def ldr_splatting(sh_dc: float) -> FitConfig:
    """Return 3DGS in display values, without exposure and tone curve, at a rate of its colours.

    Like every baseline preset it is not censored; runs of this experiment before that preset were.
    """
    cfg = p2gs_jax.preset("3dgs")
    optimizer = dataclasses.replace(cfg.optimizer, sh_dc=sh_dc, sh_rest=sh_dc / 20)
    return dataclasses.replace(cfg, optimizer=optimizer)


def variants() -> dict[str, FitConfig]:
    """Return the formulations compared."""
    robust = p2gs_jax.preset("robust")
    photometry = dataclasses.replace(robust.photometry, start="random", start_std=0.0, select=False)
    given = dataclasses.replace(robust, photometry=photometry)
    learned = without_tracks(Decisions.as_asked(given)).resolve(given)

    def reading(form: str, weight: float, correspondence: str = "depth") -> FitConfig:
        relative = dataclasses.replace(
            learned.loss.relative_exposure,
            weight=weight,
            form=form,  # pyright: ignore[reportArgumentType]
            correspondence=correspondence,  # pyright: ignore[reportArgumentType]
        )
        return dataclasses.replace(
            learned, loss=dataclasses.replace(learned.loss, relative_exposure=relative)
        )

    frozen = dataclasses.replace(
        robust, photometry=dataclasses.replace(robust.photometry, freeze_until=1.0)
    )
    softplus = dataclasses.replace(
        robust, render=dataclasses.replace(robust.render, radiance="softplus")
    )
    quantization = dataclasses.replace(
        robust, loss=dataclasses.replace(robust.loss, quantization=0.5 / 255)
    )
    uncensored = dataclasses.replace(robust, loss=dataclasses.replace(robust.loss, censored=False))
    return {
        "robust": robust,
        "robust, exposures frozen": frozen,
        "robust, softplus radiance": softplus,
        "robust, quantisation-aware": quantization,
        "robust, not censored": uncensored,
        "robust, exposures learned from 1": learned,
        "... + literal_same_pose .01": reading("literal_same_pose", 0.01),
        "... + literal_same_pose .1": reading("literal_same_pose", 0.1),
        "... + literal_pixels .01": reading("literal_pixels", 0.01),
        "... + exposed .01": reading("exposed", 0.01),
        "... + observed_linear .1": reading("observed_linear", 0.1),
        "... + observed_ldr .1": reading("observed_ldr", 0.1),
        "... + observed_linear .1, tracks": reading("observed_linear", 0.1, "tracks"),
        "... + observed_ldr .1, tracks": reading("observed_ldr", 0.1, "tracks"),
        "LDR splatting, sh 2.5e-3": ldr_splatting(2.5e-3),
        "LDR splatting, sh 5e-3": ldr_splatting(5e-3),
        "LDR splatting, sh 1e-2": ldr_splatting(1e-2),
        "paper": p2gs_jax.preset("paper"),
        "paper_appendix": p2gs_jax.preset("paper_appendix"),
    }


def judge(run: Path, street: Path) -> dict[str, float]:
    """Return the row of one finished fit."""
    row = read_row(run, street)
    return {name: row[column] for name, column in COLUMNS.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/photometry"))
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--stds", type=float, nargs="+", default=[2.0, 4.0])
    parser.add_argument("--only", nargs="+", help="names of variants")
    parser.add_argument("--width", type=int, default=320, help="pixels; 2/3 as many down")
    parser.add_argument("--max-gaussians", type=int, help="the same limit for every variant")
    args = parser.parse_args()
    table: dict[str, dict[str, list[float]]] = {}
    for std in args.stds:
        for name, cfg in variants().items():
            if args.only and name not in args.only:
                continue
            rows = []
            for seed in args.seeds:
                street = args.out / f"street_std{std:g}_{seed}_{args.width}"
                if not street.exists():
                    height = round(args.width * 0.675)
                    p2gs_jax.write_street(
                        street, iso_std=std, seed=seed, width=args.width, height=height
                    )
                slug = "".join(c if c.isalnum() else "_" for c in name)
                limit = f"_{args.max_gaussians}" if args.max_gaussians else ""
                run = args.out / f"std{std:g}_{seed}_{args.width}_{slug}_{args.steps}{limit}"
                if not (run / "metrics.json").exists():
                    train = dataclasses.replace(cfg.train, steps=args.steps, seed=seed)
                    densify = dataclasses.replace(cfg.densify, max_gaussians=args.max_gaussians)
                    p2gs_jax.fit(
                        street,
                        run,
                        dataclasses.replace(cfg, train=train, densify=densify),
                        reference=street / "reference",
                        resume=(run / "config.json").exists(),
                    )
                rows.append(judge(run, street))
            key = f"std {std:g}, {name}"
            table[key] = {k: [r[k] for r in rows] for k in rows[0]}
            cells = [f"{np.mean(v):{FORMATS.get(k, '.2f')}}" for k, v in table[key].items()]
            if len(table) == 1:
                print("| street, formulation | " + " | ".join(table[key]) + " |")
                print("|---|" + "---:|" * len(cells))
            print(f"| {key} | " + " | ".join(cells) + " |", flush=True)
    (args.out / "photometry.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
