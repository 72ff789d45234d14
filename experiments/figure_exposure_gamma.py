"""The appendix's figure: one radiance field rendered under chosen exposures and gammas.

python experiments/figure_exposure_gamma.py [--quick] [--run RUN --view NAME]

Without --run, robust on the first town of ISO std 4 is taken (and fitted, where it is not there).
The linear image is rendered once; exposure and gamma are applied afterwards. Below each image: the
largest difference from applying them to that linear image in float64, in 8-bit codes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from towns import METHODS, WIDE, fit_all, methods, options, stamp

from p2gs_jax.photometry.display import DisplayTransform, develop, mean_parameters
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import Run, load_run
from p2gs_jax.scene.pixels.store import ImageStore, camera_of

STOPS = (-2.0, -1.0, 0.0, 1.0, 2.0)
GAMMAS = (1.6, 2.2, 3.0)
ROBUST = next(name for name, preset in METHODS.items() if preset == "robust")


def expected(linear: np.ndarray, exposure: float, gamma: float, run: Run) -> np.ndarray:
    """Return y = OETF(x0 (e L / x0)^(2.2 / gamma)) in float64, for the sRGB curve only."""
    pivot = run.cfg.photometry.pivot
    x = pivot * (exposure * np.maximum(linear.astype(np.float64), 0) / pivot) ** (2.2 / gamma)
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def draw(run: Run, index: int, out: Path) -> dict:
    """Write the figure; return what it measured."""
    store = ImageStore(run.scene.views, run.cfg.data)
    render = make_renderer(run.cfg.render)
    alive = jnp.ones(run.params.gaussians.capacity, bool)
    linear = render(run.params.gaussians, alive, camera_of(store, index)).linear
    mean = mean_parameters(run.params.photometry)
    figure, axes = plt.subplots(
        len(GAMMAS), len(STOPS), figsize=(2.6 * len(STOPS), 6), layout="constrained"
    )
    rows = []
    for line, gamma in zip(axes, GAMMAS, strict=True):
        for axis, stops in zip(line, STOPS, strict=True):
            exposure = mean.exposure_geometric * 2**stops
            shown = develop(linear, DisplayTransform(exposure, gamma, run.cfg.photometry))
            row = {"ev": stops, "gamma": gamma, "mean_display": float(shown.mean())}
            if run.cfg.photometry.curve == "srgb":
                gap = np.abs(shown - expected(np.asarray(linear), exposure, gamma, run)).max()
                row["largest_gap_codes"] = float(255 * gap)
                axis.set_xlabel(f"{255 * gap:.2f} codes", fontsize=7)
            rows.append(row)
            axis.imshow(shown)
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"{stops:+.0f} EV, gamma {gamma:g}", fontsize=9)
    figure.savefig(out, dpi=72)
    plt.close(figure)
    return {"view": run.scene.views[index].name, "renderings": rows}


def main() -> None:
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--view")
    own, rest = parser.parse_known_args()
    o = options(__doc__, "figure_exposure_gamma.py", rest)
    begin = time.monotonic()
    folder = own.run
    if folder is None:
        runs = fit_all(o, {WIDE: methods([ROBUST])})
        folder = runs.folders[ROBUST, WIDE, o.protocol.towns[0]]
    run = load_run(folder)
    names = [v.name for v in run.scene.views]
    held_out = run.scene.test_indices or run.scene.train_indices
    index = held_out[0] if own.view is None else names.index(own.view)
    out = o.folder / "figure_exposure_gamma.png"
    out.parent.mkdir(parents=True, exist_ok=True)
    measured = draw(run, index, out)
    payload = {"stamp": stamp(o, time.monotonic() - begin), "run": str(folder), **measured}
    out.with_suffix(".json").write_text(json.dumps(payload, indent=1) + "\n")
    gaps = [r["largest_gap_codes"] for r in measured["renderings"] if "largest_gap_codes" in r]
    print("| exposure, EV | " + " | ".join(f"gamma {g:g}" for g in GAMMAS) + " |")
    print("|---|" + "---:|" * len(GAMMAS))
    for stops in STOPS:
        cells = [r["mean_display"] for r in measured["renderings"] if r["ev"] == stops]
        print(f"| {stops:+.0f} | " + " | ".join(f"{c:.3f}" for c in cells) + " |")
    print(
        f"\nMean display values of {measured['view']}; largest gap "
        f"{max(gaps, default=0):.2f} codes."
    )
    print(out)


if __name__ == "__main__":
    main()
