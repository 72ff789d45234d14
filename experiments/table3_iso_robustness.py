"""Table 3: what a wider spread of ISO costs each method, in reconstruction and in novel views.

python experiments/table3_iso_robustness.py            # about 50 runs
python experiments/table3_iso_robustness.py --quick    # one small town, minutes

Two ways to judge: `photographs` as the paper does it, rendering with the mean parameters of the
training views; and `ISO 8`, against photographs of the same views at one common exposure, which the
paper does not have (one scale per run is fitted, since radiance has none of its own).
"""

from __future__ import annotations

import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from towns import (
    CONSTANT,
    METHODS,
    NARROW,
    NOT_BUILT,
    STD_NAMES,
    WIDE,
    Options,
    Runs,
    fit_all,
    methods,
    number,
    options,
    table,
    write,
)

MAIN = ("3DGS", "3DGS + AT", "3DGS + curve (as Luminance-GS)", "P2GS as printed", "robust (ours)")
# Table 3 of the paper (CARLA, 1920x1300, 30,000 steps): PSNR of reconstruction, of novel views.
PAPER = {
    "3DGS": {NARROW: (21.45, 19.83), WIDE: (19.25, 16.04)},
    "3DGS + AT": {NARROW: (22.28, 19.63), WIDE: (19.11, 16.14)},
    "3DGS + curve (as Luminance-GS)": {NARROW: (17.36, 16.99), WIDE: (11.43, 14.82)},
    "P2GS as printed": {NARROW: (23.76, 22.72), WIDE: (22.91, 21.77)},
}
ISO8 = ("reference", "scale_aligned")


def wanted():
    """Return ISO std -> methods: the main ones everywhere, all on the widest spread."""
    return {CONSTANT: methods(MAIN), WIDE: methods(), NARROW: methods(MAIN)}


def rows(runs: Runs) -> list[list[str]]:
    out = []
    for name in METHODS:
        for std in (CONSTANT, NARROW, WIDE):
            if (name, std) not in {(m, s) for m, s, _ in runs.metrics}:
                continue

            def cell(*path: str, digits: int = 2, name=name, std=std) -> str:
                return number(runs.mean(name, std, *path), digits)

            printed = PAPER.get(name, {}).get(std)
            out.append(
                [
                    name,
                    STD_NAMES[std],
                    cell("train", "averaged", "ssim", digits=3),
                    cell("train", "averaged", "psnr"),
                    cell("train", "averaged", "lpips", digits=3),
                    cell("test", "averaged", "ssim", digits=3),
                    cell("test", "averaged", "psnr"),
                    cell("test", "averaged", "lpips", digits=3),
                    cell(*ISO8, "train", "psnr"),
                    cell(*ISO8, "test", "psnr"),
                    cell(*ISO8, "test", "ssim", digits=3),
                    cell("ev", digits=4) if std and name[0] in "Pr" else "",
                    "" if printed is None else f"{printed[0]:.2f} / {printed[1]:.2f}",
                ]
            )
    return out


HEADER = (
    "method",
    "trained on",
    "SSIM",
    "PSNR",
    "LPIPS",
    "novel SSIM",
    "novel PSNR",
    "novel LPIPS",
    "ISO 8 PSNR",
    "ISO 8 novel PSNR",
    "ISO 8 novel SSIM",
    "EV error",
    "paper (CARLA): PSNR / novel",
)


def deltas(runs: Runs) -> list[list[str]]:
    out = []
    for name in MAIN:

        def change(a: float, b: float, *path: str, name=name) -> str:
            return number(runs.mean(name, b, *path) - runs.mean(name, a, *path), 2)

        printed = PAPER.get(name)
        out.append(
            [
                name,
                change(NARROW, WIDE, "train", "averaged", "psnr"),
                change(NARROW, WIDE, "test", "averaged", "psnr"),
                change(NARROW, WIDE, *ISO8, "train", "psnr"),
                change(NARROW, WIDE, *ISO8, "test", "psnr"),
                change(CONSTANT, WIDE, *ISO8, "train", "psnr"),
                change(CONSTANT, WIDE, *ISO8, "test", "psnr"),
                ""
                if printed is None
                else " / ".join(f"{printed[WIDE][k] - printed[NARROW][k]:.2f}" for k in (0, 1)),
            ]
        )
    return out


def plot(o: Options, runs: Runs) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharex=True, layout="constrained")
    stds = (CONSTANT, NARROW, WIDE)
    for axis, path, title in (
        (axes[0], ("test", "averaged", "psnr"), "novel views, photographs, mean parameters"),
        (axes[1], (*ISO8, "test", "psnr"), "novel views, judged at ISO 8"),
    ):
        for name, marker in zip(MAIN, "osD^*", strict=True):
            axis.plot(stds, [runs.mean(name, s, *path) for s in stds], marker=marker, label=name)
        axis.set(title=title, xlabel="ISO standard deviation", ylabel="PSNR, dB", xticks=stds)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    figure.savefig(o.out / o.protocol.name / "table3_iso_robustness.png", dpi=120)
    plt.close(figure)


def main() -> None:
    o = options(__doc__, "table3_iso_robustness")
    begin = time.monotonic()
    runs = fit_all(o, wanted())
    change = table(
        (
            "change of PSNR",
            "std 2 to 4",
            "novel",
            "std 2 to 4, ISO 8",
            "novel, ISO 8",
            "const to std 4, ISO 8",
            "novel, ISO 8",
            "paper: std 2 to 4 / novel",
        ),
        deltas(runs),
    )
    text = table(HEADER, rows(runs)) + "\n" + change + "\n" + NOT_BUILT + "\n"
    write(o, "table3_iso_robustness", text, runs, begin)
    plot(o, runs)


if __name__ == "__main__":
    main()
