"""Four tables of the paper and our `ladders`, on three procedural towns with HDR truth.

python experiments/tables.py reconstruction | novel_views | iso | ablation | ladders [--quick]

`reconstruction` (paper, table 1): training views, ISO with standard deviation 4: scores, FPS.
`novel_views` (table 2): every eighth frame of every camera. `iso` (table 3): what a wider spread of
ISO costs each method. `ablation` (table 4): robust and the printed method without one part at a
time. `ladders`: error against Gaussians, SH degree and photometric model.

`own` shows every view with the exposure and correction that the method gave it. `mean` shows all
views with the mean parameters of the training views, as the paper does. `fitted` fits an exposure
to each photograph. `ISO 8` compares with photographs at one common exposure under one scale, which
tests the radiance and not the exposures. HIS and Std-Luminance are those of renders with mean
parameters, as printed and corrected (docs/files.md); FPS are measured when the table is made.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
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
    table,
    titles,
    write,
)

from p2gs_jax.config import FitConfig
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.presets import preset
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.pixels.store import ImageStore, camera_of

ROBUST, PRINTED = "robust (ours)", "P2GS as printed"
MAIN = ("3DGS", "3DGS + AT", "Luminance-GS", PRINTED, ROBUST)
SCORES = (("SSIM", 3), ("PSNR", 2), ("LPIPS", 3))


def scores(label: str, path: Sequence[str], names: str = "SSIM PSNR LPIPS") -> tuple[Column, ...]:
    """Return columns of these scores under one protocol."""
    return tuple(
        (f"{label} {name}".strip(), (*path, name.lower()), digits)
        for name, digits in SCORES
        if name in names.split()
    )


# ------------------------------------------------------------------ table 1

# Waymo: FPS on its GPU, SSIM, PSNR, HIS, Std-Luminance.
PAPER_1 = {
    "photographs": "0.096 / 0.041 (HIS / Std)",
    "3DGS": "146 / 0.928 / 33.62 / 0.102 / 0.041",
    "3DGS + AT": "145 / 0.927 / 31.45 / 0.097 / 0.035",
    "Luminance-GS": "- / 0.863 / 17.68 / 0.497 / 0.047",
    PRINTED: "90 / 0.939 / 31.02 / 0.092 / 0.034",
}
QUALITY = (
    *scores("own", ("train",), "PSNR"),
    *scores("mean", ("train", "averaged")),
    *scores("ISO 8", (*ISO8, "train")),
)
STEADINESS = {
    "his_paper": "HIS printed",
    "his": "HIS",
    "std_luminance": "Std-L printed",
    "std_luminance_relative": "Std-L",
}
TIMED_VIEWS = 12


def steadiness(of: str) -> tuple[Column, ...]:
    """Return the columns of STEADINESS, of the `averaged` renders or of the `photographs`."""
    return tuple((title, ("consistency", of, key), 3) for key, title in STEADINESS.items())


def frames_per_second(run: Path) -> float:
    """Return 1 / the median time to render a view of a finished run, depth included."""
    loaded = load_run(run)
    store = ImageStore(loaded.scene.views, loaded.cfg.data)
    render = make_renderer(loaded.cfg.render)
    alive = jnp.ones(loaded.params.gaussians.capacity, bool)
    cameras = [camera_of(store, i) for i in range(min(TIMED_VIEWS, len(loaded.scene.views)))]
    seconds = []
    for camera in [cameras[0], *cameras]:
        begin = time.perf_counter()
        render(loaded.params.gaussians, alive, camera).linear.block_until_ready()
        seconds.append(time.perf_counter() - begin)
    return 1.0 / float(np.median(seconds[1:]))


def reconstruction(runs: Runs, fps: dict[str, float]) -> str:
    columns = (*QUALITY, *steadiness("averaged"))
    header = ("method", "FPS", *titles(columns), EV_ERROR[0], "paper: FPS, SSIM, PSNR, HIS, Std-L")
    photographs = runs.cells("3DGS", WIDE, steadiness("photographs"))
    rows = [
        ["photographs", *[""] * (1 + len(QUALITY)), *photographs, "", PAPER_1["photographs"]],
        *(
            [
                name,
                number(fps.get(name, float("nan")), 0),
                *runs.cells(name, WIDE, columns),
                runs.ev_error(name, WIDE),
                PAPER_1.get(name, ""),
            ]
            for name in METHODS
        ),
    ]
    return table(header, rows) + "\n" + NOT_BUILT + "\n"


# ------------------------------------------------------------------ table 2

# Waymo: SSIM, PSNR, LPIPS.
PAPER_2 = {
    "3DGS": "0.893 / 30.39 / 0.258",
    "3DGS + AT": "0.890 / 28.89 / 0.263",
    "Luminance-GS": "0.630 / 16.44 / 0.427",
    PRINTED: "0.896 / 28.34 / 0.246",
}
PROTOCOLS = {
    "mean": ("test", "averaged"),
    "fitted": ("test", "exposure_fitted"),
    "ISO 8": (*ISO8, "test"),
}


def novel_views(runs: Runs) -> str:
    columns = [column for label, path in PROTOCOLS.items() for column in scores(label, path)]
    rows = [[name, *runs.cells(name, WIDE, columns), PAPER_2.get(name, "")] for name in METHODS]
    header = ("method", *titles(columns), "paper (Waymo): SSIM / PSNR / LPIPS")
    return table(header, rows) + "\n" + NOT_BUILT + "\n"


# ------------------------------------------------------------------ table 3

# CARLA, 1920x1300, 30,000 steps: PSNR of reconstruction, of novel views.
PAPER_3 = {
    "3DGS": {NARROW: (21.45, 19.83), WIDE: (19.25, 16.04)},
    "3DGS + AT": {NARROW: (22.28, 19.63), WIDE: (19.11, 16.14)},
    "Luminance-GS": {NARROW: (17.36, 16.99), WIDE: (11.43, 14.82)},
    PRINTED: {NARROW: (23.76, 22.72), WIDE: (22.91, 21.77)},
}
COLUMNS_3 = (
    *scores("", ("train", "averaged")),
    *scores("novel", ("test", "averaged")),
    *scores("ISO 8", (*ISO8, "train"), "PSNR"),
    *scores("ISO 8 novel", (*ISO8, "test"), "SSIM PSNR"),
)
# Title, ISO std before and after, where metrics.json has the PSNR.
CHANGES = (
    ("std 2 to 4", NARROW, WIDE, ("train", "averaged", "psnr")),
    ("novel, std 2 to 4", NARROW, WIDE, ("test", "averaged", "psnr")),
    ("std 2 to 4, ISO 8", NARROW, WIDE, (*ISO8, "train", "psnr")),
    ("novel, std 2 to 4, ISO 8", NARROW, WIDE, (*ISO8, "test", "psnr")),
    ("const to std 4, ISO 8", CONSTANT, WIDE, (*ISO8, "train", "psnr")),
    ("novel, const to std 4, ISO 8", CONSTANT, WIDE, (*ISO8, "test", "psnr")),
)


def iso_methods() -> dict[float, dict[str, FitConfig]]:
    """Return ISO std -> methods: the main ones everywhere, all on the widest spread."""
    return {CONSTANT: methods(MAIN), WIDE: methods(), NARROW: methods(MAIN)}


def iso(runs: Runs) -> str:
    fitted = {(method, std) for method, std, _ in runs.metrics}
    rows = [
        [
            name,
            STD_NAMES[std],
            *runs.cells(name, std, COLUMNS_3),
            runs.ev_error(name, std),
            _pair(PAPER_3.get(name, {}).get(std, ())),
        ]
        for name in METHODS
        for std in (CONSTANT, NARROW, WIDE)
        if (name, std) in fitted
    ]
    header = ("method", "trained on", *titles(COLUMNS_3), EV_ERROR[0], "paper (CARLA)")
    change_header = ("change of PSNR", *(c[0] for c in CHANGES), "paper: std 2 to 4 / novel")
    return "\n".join([table(header, rows), table(change_header, changes(runs)), NOT_BUILT, ""])


def changes(runs: Runs) -> list[list[str]]:
    """Return the rows that compare spreads of ISO."""
    out = []
    for name in MAIN:
        found = [
            runs.mean(name, after, *path) - runs.mean(name, before, *path)
            for _, before, after, path in CHANGES
        ]
        printed = PAPER_3.get(name)
        pairs = () if printed is None else zip(printed[WIDE], printed[NARROW], strict=True)
        losses = _pair(wide - narrow for wide, narrow in pairs)
        out.append([name, *(number(change, 2) for change in found), losses])
    return out


def _pair(values: Iterable[float]) -> str:
    return " / ".join(f"{v:.2f}" for v in values)


def plot_iso(runs: Runs) -> Figure:
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
    return figure


# ------------------------------------------------------------------ table 4

# Waymo: PSNR.
PAPER_4 = {PRINTED: "33.61", "printed, no L_exp": "27.88", "printed, no L_reg": "27.47"}
LEARNED = {"photometry.start": "random", "photometry.start_std": 0.0, "photometry.select": False}
GIVEN = {"photometry.select": False, "photometry.model": "view_exposure_gamma"}
REGULARIZERS = ("exposure_scale", "exposure_variance", "gamma_prior")
COLUMNS_4 = (
    EV_ERROR,
    ("radiance, stops", ("radiance", "stops_rms"), 3),
    *scores("own", ("train",), "PSNR"),
    *scores("mean", ("train", "averaged")),
    *scores("ISO 8", (*ISO8, "train"), "PSNR"),
    *scores("ISO 8 novel", (*ISO8, "test"), "SSIM PSNR"),
)


def ablations() -> dict[str, FitConfig]:
    """Return robust and the printed method, each without one part at a time."""
    robust, paper = preset("robust"), preset("paper")
    learned = with_fields(robust, LEARNED)
    reg = "loss.regularizers."
    no_gauge = {f"{reg}log_exposure_mean": None, f"{reg}gamma_mean_variance": None}
    on_photographs = {
        "loss.relative_exposure.weight": 0.1,
        "loss.relative_exposure.form": "observed_ldr",
    }
    linear = {
        "render.radiance": "linear",
        "optimizer.sh_dc": 2e-2,
        "optimizer.sh_rest": 1e-3,
    }
    fields = {
        ROBUST: (robust, {}),
        "robust, no bundle adjustment": (learned, {}),
        "robust, no bundle adjustment, no gauge regularisers": (learned, no_gauge),
        "robust, no bundle adjustment, L_exp on photographs": (learned, on_photographs),
        "robust, no selection (gamma per view)": (robust, GIVEN),
        "robust, no selection, pivot at white": (robust, GIVEN | {"photometry.pivot": 1.0}),
        "robust, linear radiance": (robust, linear),
        "robust, not censored": (robust, {"loss.censored": False}),
        "robust, no D-SSIM": (robust, {"loss.dssim_weight": None}),
        PRINTED: (paper, {}),
        "printed, no L_exp": (paper, {"loss.relative_exposure.weight": None}),
        "printed, no L_reg": (paper, {f"{reg}{name}": None for name in REGULARIZERS}),
        **{
            f"printed, no {name.replace('_', ' ')} term": (paper, {f"{reg}{name}": None})
            for name in REGULARIZERS
        },
    }
    return {name: with_fields(base, changed) for name, (base, changed) in fields.items()}


def ablation(runs: Runs) -> str:
    rows = [[n, *runs.cells(n, WIDE, COLUMNS_4), PAPER_4.get(n, "")] for n in ablations()]
    return table(("variant", *titles(COLUMNS_4), "paper (Waymo): PSNR"), rows)


def plot_ablation(runs: Runs) -> Figure:
    names = list(ablations())
    values = [runs.mean(name, WIDE, *ISO8, "test", "psnr") for name in names]
    figure = Figure(figsize=(8, 5), layout="constrained")
    axis = figure.subplots()
    axis.set(yticks=np.arange(len(names)), xlabel="PSNR of held-out views at ISO 8, dB")
    axis.set_yticklabels(names, fontsize=7)
    axis.invert_yaxis()
    colors = ["tab:green" if n.startswith("robust") else "tab:blue" for n in names]
    bars = axis.barh(np.arange(len(names)), values, color=colors)
    axis.bar_label(bars, fmt="%.2f", fontsize=7, padding=2)
    axis.set_xlim(left=min(values) - 2)
    return figure


# ------------------------------------------------------------------ what a scene needs

FACTORS = (0.5, 1.0, 1.6, 2.5, 4.0)
DEGREES = (0, 1, 2, 3)
COLUMNS_LADDERS = (
    ("Gaussians", ("counts", "gaussians"), 0),
    ("seconds", ("seconds", "optimisation"), 0),
    *scores("own", ("train",), "PSNR"),
    ("novel PSNR, exposure fitted", ("test", "exposure_fitted", "psnr"), 2),
    *scores("ISO 8", (*ISO8, "train"), "PSNR"),
    *scores("ISO 8 novel", (*ISO8, "test"), "PSNR"),
    ("radiance, stops", ("radiance", "stops_rms"), 3),
    EV_ERROR,
)


def ladder_configs(points: int) -> dict[str, FitConfig]:
    """Return the three ladders, each about robust as it is."""
    robust = preset("robust")
    counts = {
        f"Gaussians: {n}": {"densify.max_gaussians": n, "init.max_seeds": n}
        for n in (int(f * points) for f in FACTORS)
    }
    degrees = {f"SH degree {d}": {"render.sh_degree": d} for d in DEGREES}
    models = {
        f"model: {m.replace('_', ' ')}": {"photometry.select": False, "photometry.model": m}
        for m in MODELS
    }
    ladders = counts | models | {"model: chosen": {}} | degrees
    return {name: with_fields(robust, fields) for name, fields in ladders.items()}


def ladders(runs: Runs) -> str:
    names = list(dict.fromkeys(method for method, _, _ in runs.metrics))
    return "\n".join(
        table(
            ("", *titles(COLUMNS_LADDERS)),
            [[n, *runs.cells(n, WIDE, COLUMNS_LADDERS)] for n in names if n.startswith(part)],
        )
        for part in ("Gaussians", "SH", "model")
    )


# ------------------------------------------------------------------ command line


def make(o: Options, name: str) -> None:
    """Run the fits of a table, and write it."""
    begin, plot, extra = time.monotonic(), None, None
    if name == "ladders":
        # The ladder sets the number of Gaussians itself.
        o = dataclasses.replace(o, protocol=dataclasses.replace(o.protocol, gaussians=None))
        runs = fit_all(o, {WIDE: ladder_configs(o.protocol.points)})
        text = ladders(runs)
    elif name == "ablation":
        runs = fit_all(o, {WIDE: ablations()})
        text, plot = ablation(runs), plot_ablation
    elif name == "iso":
        runs = fit_all(o, iso_methods())
        text, plot = iso(runs), plot_iso
    else:
        runs = fit_all(o, {WIDE: methods()})
        text = novel_views(runs)
        if name == "reconstruction":
            first = o.protocol.towns[0]
            fps = {m: frames_per_second(f) for (m, _, t), f in runs.folders.items() if t == first}
            text, extra = reconstruction(runs, fps), {"fps": fps}
    write(o, name, text, runs, begin, extra)
    if plot is not None:
        plot(runs).savefig(o.folder / f"{name}.png", dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(add_help=False)
    names = ("reconstruction", "novel_views", "iso", "ablation", "ladders")
    parser.add_argument("table", choices=names)
    chosen, rest = parser.parse_known_args()
    make(options(__doc__, f"tables.py {chosen.table}", rest), chosen.table)


if __name__ == "__main__":
    main()
