"""Table 3: what a wider spread of ISO costs each method, in reconstruction and in novel views.

python experiments/table3_iso_robustness.py            # about 50 runs
python experiments/table3_iso_robustness.py --quick    # one small town, minutes

Two ways to judge: `photographs` as the paper does it, rendering with the mean parameters of the
training views; and `ISO 8`, against photographs of the same views at one common exposure, which the
paper does not have (one scale per run is fitted, since radiance has none of its own).
"""

from __future__ import annotations

import time
from collections.abc import Iterable

from matplotlib.figure import Figure
from towns import (
    CONSTANT,
    EV_ERROR,
    ISO8,
    METHODS,
    NARROW,
    NOT_BUILT,
    STD_NAMES,
    WIDE,
    Column,
    Options,
    Runs,
    fit_all,
    methods,
    number,
    options,
    save_plot,
    table,
    titles,
    write,
)

MAIN = ("3DGS", "3DGS + AT", "Luminance-GS", "P2GS as printed", "robust (ours)")
# Table 3 of the paper (CARLA, 1920x1300, 30,000 steps): PSNR of reconstruction, of novel views.
PAPER = {
    "3DGS": {NARROW: (21.45, 19.83), WIDE: (19.25, 16.04)},
    "3DGS + AT": {NARROW: (22.28, 19.63), WIDE: (19.11, 16.14)},
    "Luminance-GS": {NARROW: (17.36, 16.99), WIDE: (11.43, 14.82)},
    "P2GS as printed": {NARROW: (23.76, 22.72), WIDE: (22.91, 21.77)},
}
COLUMNS: tuple[Column, ...] = (
    ("SSIM", ("train", "averaged", "ssim"), 3),
    ("PSNR", ("train", "averaged", "psnr"), 2),
    ("LPIPS", ("train", "averaged", "lpips"), 3),
    ("novel SSIM", ("test", "averaged", "ssim"), 3),
    ("novel PSNR", ("test", "averaged", "psnr"), 2),
    ("novel LPIPS", ("test", "averaged", "lpips"), 3),
    ("ISO 8 PSNR", (*ISO8, "train", "psnr"), 2),
    ("ISO 8 novel PSNR", (*ISO8, "test", "psnr"), 2),
    ("ISO 8 novel SSIM", (*ISO8, "test", "ssim"), 3),
)
HEADER = ("method", "trained on", *titles(COLUMNS), EV_ERROR[0], "paper (CARLA): PSNR / novel")
# Title, ISO std before and after, where metrics.json has the PSNR.
CHANGES = (
    ("std 2 to 4", NARROW, WIDE, ("train", "averaged", "psnr")),
    ("novel", NARROW, WIDE, ("test", "averaged", "psnr")),
    ("std 2 to 4, ISO 8", NARROW, WIDE, (*ISO8, "train", "psnr")),
    ("novel, ISO 8", NARROW, WIDE, (*ISO8, "test", "psnr")),
    ("const to std 4, ISO 8", CONSTANT, WIDE, (*ISO8, "train", "psnr")),
    ("novel, ISO 8", CONSTANT, WIDE, (*ISO8, "test", "psnr")),
)
CHANGE_HEADER = ("change of PSNR", *(c[0] for c in CHANGES), "paper: std 2 to 4 / novel")


def wanted():
    """Return ISO std -> methods: the main ones everywhere, all on the widest spread."""
    return {CONSTANT: methods(MAIN), WIDE: methods(), NARROW: methods(MAIN)}


def rows(runs: Runs) -> list[list[str]]:
    fitted = {(method, std) for method, std, _ in runs.metrics}
    return [
        [
            name,
            STD_NAMES[std],
            *runs.cells(name, std, COLUMNS),
            runs.ev_error(name, std),
            _pair(PAPER.get(name, {}).get(std, ())),
        ]
        for name in METHODS
        for std in (CONSTANT, NARROW, WIDE)
        if (name, std) in fitted
    ]


def deltas(runs: Runs) -> list[list[str]]:
    out = []
    for name in MAIN:
        changes = [
            runs.mean(name, after, *path) - runs.mean(name, before, *path)
            for _, before, after, path in CHANGES
        ]
        printed = PAPER.get(name)
        pairs = () if printed is None else zip(printed[WIDE], printed[NARROW], strict=True)
        losses = _pair(wide - narrow for wide, narrow in pairs)
        out.append([name, *(number(change, 2) for change in changes), losses])
    return out


def _pair(values: Iterable[float]) -> str:
    return " / ".join(f"{v:.2f}" for v in values)


def plot(o: Options, runs: Runs) -> None:
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True)
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
    save_plot(o, "table3_iso_robustness", figure)


def main() -> None:
    o = options(__doc__, "table3_iso_robustness")
    begin = time.monotonic()
    runs = fit_all(o, wanted())
    change = table(CHANGE_HEADER, deltas(runs))
    text = table(HEADER, rows(runs)) + "\n" + change + "\n" + NOT_BUILT + "\n"
    write(o, "table3_iso_robustness", text, runs, begin)
    plot(o, runs)


if __name__ == "__main__":
    main()
