"""Every formulation of the photometry on full reconstructions of streets with known exposures.

python experiments/photometry_on_street.py --out runs/photometry --steps 600 --seeds 0 1 2

Streets of ISO std 2 and 4. Fixed steps, so that the load of the machine does not matter. Finished
fits are kept: run it again to continue. Columns: exposure error in stops after scale alignment (EV)
and after scale and power (EVp), radiance error in stops (RMS, unsaturated pixels), and PSNR against
photographs at ISO 8, of all views (scale aligned) and of held-out views.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import json
from pathlib import Path

import numpy as np

import p2gs_jax
from p2gs_jax.config import FitConfig
from p2gs_jax.prepare import without_tracks


def variants() -> dict[str, FitConfig]:
    """Return the formulations compared."""
    robust = p2gs_jax.preset("robust")
    photometry = dataclasses.replace(robust.photometry, start="random", start_std=0.0, select=False)
    learned = without_tracks(dataclasses.replace(robust, photometry=photometry))

    def reading(form: str, weight: float) -> FitConfig:
        relative = dataclasses.replace(
            learned.loss.relative_exposure,
            weight=weight,
            form=form,  # pyright: ignore[reportArgumentType]
        )
        return dataclasses.replace(
            learned, loss=dataclasses.replace(learned.loss, relative_exposure=relative)
        )

    tuned = dataclasses.replace(
        robust, photometry=dataclasses.replace(robust.photometry, freeze_until=1.0)
    )
    return {
        "robust": robust,
        "robust, exposures frozen": tuned,
        "robust, exposures learned from 1": learned,
        "... + literal_same_pose .01": reading("literal_same_pose", 0.01),
        "... + literal_same_pose .1": reading("literal_same_pose", 0.1),
        "... + literal_pixels .01": reading("literal_pixels", 0.01),
        "... + exposed .01": reading("exposed", 0.01),
        "... + observed_linear .1": reading("observed_linear", 0.1),
        "... + observed_ldr .1": reading("observed_ldr", 0.1),
        "paper": p2gs_jax.preset("paper"),
        "paper_appendix": p2gs_jax.preset("paper_appendix"),
    }


def truth_of(street: Path) -> dict[str, float]:
    with (street / "truth" / "exposures.csv").open(newline="") as file:
        return {row["image"]: float(row["exposure"]) for row in csv.DictReader(file)}


def judge(run: Path, street: Path) -> dict[str, float]:
    """Return the row of one finished fit."""
    metrics = json.loads((run / "metrics.json").read_text())
    saved = json.loads((run / "photometry.json").read_text())
    truth = truth_of(street)
    pairs = [(v["exposure"], truth[v["image"]]) for v in saved["views"] if v["exposure"]]
    error = p2gs_jax.exposure_error(*np.array(pairs).T)
    aligned = metrics["reference"]["scale_aligned"]
    return {
        "ev": error["ev"],
        "ev_power": error["ev_scale_power"],
        "stops": metrics["radiance"]["stops_rms"],
        "training": metrics["train"]["psnr"],
        "iso8": aligned["psnr"],
        "iso8_held_out": aligned["test"]["psnr"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/photometry"))
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--stds", type=float, nargs="+", default=[2.0, 4.0])
    parser.add_argument("--only", nargs="+", help="names of variants")
    args = parser.parse_args()
    table: dict[str, dict[str, list[float]]] = {}
    for std in args.stds:
        for name, cfg in variants().items():
            if args.only and name not in args.only:
                continue
            rows = []
            for seed in args.seeds:
                street = args.out / f"street_std{std:g}_{seed}"
                if not street.exists():
                    p2gs_jax.write_street(street, iso_std=std, seed=seed)
                slug = "".join(c if c.isalnum() else "_" for c in name)
                run = args.out / f"std{std:g}_{seed}_{slug}_{args.steps}"
                if not (run / "metrics.json").exists():
                    train = dataclasses.replace(cfg.train, steps=args.steps, seed=seed)
                    p2gs_jax.fit(
                        street,
                        run,
                        dataclasses.replace(cfg, train=train),
                        reference=street / "reference",
                        resume=(run / "config.json").exists(),
                    )
                rows.append(judge(run, street))
            key = f"std {std:g}, {name}"
            table[key] = {k: [r[k] for r in rows] for k in rows[0]}
            cells = [
                f"{np.mean(v):.3f}" if "ev" in k or k == "stops" else f"{np.mean(v):.2f}"
                for k, v in table[key].items()
            ]
            if len(table) == 1:
                print("| street, formulation | " + " | ".join(table[key]) + " |")
                print("|---|" + "---:|" * len(cells))
            print(f"| {key} | " + " | ".join(cells) + " |", flush=True)
    (args.out / "photometry.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
