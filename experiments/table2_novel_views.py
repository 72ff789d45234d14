"""Table 2: held-out views, every eighth frame of every camera.

python experiments/table2_novel_views.py [--quick]

On ISO std 4. `mean`: rendered with the mean parameters of the training views (paper); `fitted`:
with one exposure fitted to each photograph; `ISO 8`: against photographs at one common exposure,
which tests the radiance and not the exposures.
"""

from __future__ import annotations

import time

import numpy as np
from matplotlib.figure import Figure
from towns import (
    ISO8,
    METHODS,
    NOT_BUILT,
    WIDE,
    Column,
    Options,
    Runs,
    fit_all,
    methods,
    options,
    save_plot,
    table,
    titles,
    write,
)

# Table 2 of the paper (Waymo): SSIM, PSNR, LPIPS.
PAPER = {
    "3DGS": ".893 / 30.39 / .258",
    "3DGS + AT": ".890 / 28.89 / .263",
    "Luminance-GS": ".630 / 16.44 / .427",
    "P2GS as printed": ".896 / 28.34 / .246",
}
PROTOCOLS = {
    "mean": ("test", "averaged"),
    "fitted": ("test", "exposure_fitted"),
    "ISO 8": (*ISO8, "test"),
}
COLUMNS: tuple[Column, ...] = tuple(
    (f"{label} {score}", (*path, score.lower()), digits)
    for label, path in PROTOCOLS.items()
    for score, digits in (("SSIM", 3), ("PSNR", 2), ("LPIPS", 3))
)
HEADER = ("method", *titles(COLUMNS), "paper (Waymo): SSIM / PSNR / LPIPS")


def rows(runs: Runs) -> list[list[str]]:
    return [[name, *runs.cells(name, WIDE, COLUMNS), PAPER.get(name, "")] for name in METHODS]


def plot(o: Options, runs: Runs) -> None:
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    places = np.arange(len(METHODS))
    for k, (label, path) in enumerate(PROTOCOLS.items()):
        values = [runs.mean(name, WIDE, *path, "psnr") for name in METHODS]
        bars = axis.barh(places + 0.27 * (1 - k), values, 0.26, label=label)
        axis.bar_label(bars, fmt="%.1f", fontsize=6, padding=2)
    axis.set(yticks=places, xlabel="PSNR of held-out views, dB", xlim=(10, None))
    axis.set_yticklabels(METHODS)
    axis.invert_yaxis()
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    save_plot(o, "table2_novel_views", figure)


def main() -> None:
    o = options(__doc__, "table2_novel_views")
    begin = time.monotonic()
    runs = fit_all(o, {WIDE: methods()})
    text = table(HEADER, rows(runs)) + "\n" + NOT_BUILT + "\n"
    write(o, "table2_novel_views", text, runs, begin)
    plot(o, runs)


if __name__ == "__main__":
    main()
