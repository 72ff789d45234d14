"""Table 2: held-out views, every eighth frame of every camera.

python experiments/table2_novel_views.py [--quick]

On ISO std 4. `mean`: rendered with the mean parameters of the training views (paper); `fitted`:
with one exposure fitted to each photograph; `ISO 8`: against photographs at one common exposure,
which tests the radiance and not the exposures.
"""

from __future__ import annotations

import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from towns import METHODS, NOT_BUILT, WIDE, Options, Runs, fit_all, methods, number, options, write
from towns import table as markdown

# Table 2 of the paper (Waymo): SSIM, PSNR, LPIPS.
PAPER = {
    "3DGS": ".893 / 30.39 / .258",
    "3DGS + AT": ".890 / 28.89 / .263",
    "3DGS + curve (as Luminance-GS)": ".630 / 16.44 / .427",
    "P2GS as printed": ".896 / 28.34 / .246",
}
PROTOCOLS = {
    "mean": ("test", "averaged"),
    "fitted": ("test", "exposure_fitted"),
    "ISO 8": ("reference", "scale_aligned", "test"),
}
SCORES = (("ssim", 3), ("psnr", 2), ("lpips", 3))


def rows(runs: Runs) -> list[list[str]]:
    return [
        [
            name,
            *(
                number(runs.mean(name, WIDE, *path, score), digits)
                for path in PROTOCOLS.values()
                for score, digits in SCORES
            ),
            PAPER.get(name, ""),
        ]
        for name in METHODS
    ]


def plot(o: Options, runs: Runs) -> None:
    figure, axis = plt.subplots(figsize=(8, 3.6), layout="constrained")
    places = np.arange(len(METHODS))
    for k, (label, path) in enumerate(PROTOCOLS.items()):
        values = [runs.mean(name, WIDE, *path, "psnr") for name in METHODS]
        bars = axis.barh(places + 0.27 * (1 - k), values, 0.26, label=label)
        axis.bar_label(bars, fmt="%.1f", fontsize=6, padding=2)
    axis.set(yticks=places, xlabel="PSNR of held-out views, dB", xlim=(10, None))
    axis.set_yticklabels(METHODS)
    axis.invert_yaxis()
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    figure.savefig(o.out / o.protocol.name / "table2_novel_views.png", dpi=120)
    plt.close(figure)


def main() -> None:
    o = options(__doc__, "table2_novel_views")
    begin = time.monotonic()
    runs = fit_all(o, {WIDE: methods()})
    names = {"ssim": "SSIM", "psnr": "PSNR", "lpips": "LPIPS"}
    header = ("method", *(f"{p} {names[s]}" for p in PROTOCOLS for s, _ in SCORES))
    text = markdown((*header, "paper (Waymo): SSIM / PSNR / LPIPS"), rows(runs))
    write(o, "table2_novel_views", text + "\n" + NOT_BUILT + "\n", runs, begin)
    plot(o, runs)


if __name__ == "__main__":
    main()
