"""Benches as Markdown, JSON and pictures."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import NamedTuple

import jax
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FormatStrFormatter, NullFormatter

from p2gs_jax.bench.growth import GrowthCurve
from p2gs_jax.bench.hard_cases import CASES, Gap
from p2gs_jax.bench.implementations import Timing, Work
from p2gs_jax.bench.levels import Level
from p2gs_jax.bench.memory import Footprint
from p2gs_jax.bench.metrics import ACCURACY, METRICS
from p2gs_jax.bench.speed_error import DEFAULT, MeasuredVariant, front
from p2gs_jax.bench.step import StepCost
from p2gs_jax.core.atomic import atomic_write

LEVEL_ACCURACY = ("relative", "relative_99", "gradient", "gradient_99")
MARKERS = "osD^vPXhp*<>"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#555555")


def stamp() -> dict:
    """Return what a figure depends on besides the code."""
    return {
        "jax": jax.__version__,
        "backend": jax.default_backend(),
        "device": jax.devices()[0].device_kind,
        "architecture": platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
    }


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table, first column left, the others right."""
    rule = "|" + "---|" + "---:|" * (len(header) - 1)
    return (
        "\n".join("| " + " | ".join(r) + " |" for r in [header])
        + "\n"
        + rule
        + "\n"
        + "\n".join("| " + " | ".join(r) + " |" for r in rows)
    )


def _number(name: str, value: float) -> str:
    return f"{value:.1f}" if name == "psnr" else f"{value:.1e}"


def speed_error_table(points: list[MeasuredVariant]) -> str:
    """Return the table of `speed_error.measure_speed_error`."""
    on_front = front(points)
    rows = []
    for p in points:
        numerics = "" if p.numerics is None else _number("gradient", p.numerics["gradient"])
        relative = "" if p.numerics is None else _number("relative", p.numerics["relative"])
        rows.append(
            [
                p.variant.name + (" *" if p.variant.name in on_front else ""),
                *(f"{p.milliseconds[k]:.1f}" for k in ("forward", "both")),
                *(_number(k, p.error[k]) for k in ACCURACY),
                relative,
                numerics,
                f"{p.entries / 1e3:.0f}k",
                f"{p.temporaries / 1e6:.0f}",
            ]
        )
    header = ["variant (* on the front)", "fwd ms", "fwd+bwd ms"]
    header += [METRICS[k].title for k in ACCURACY]
    return markdown([*header, "rel., same cutoff", "grad., same cutoff", "entries", "MB"], rows)


class _Panel(NamedTuple):
    time: str
    error: str
    xlabel: str
    ylabel: str
    numerics: bool


PANELS = (
    _Panel("forward", "max_abs", "forward, ms", "largest error, image (mean radiance 0.18)", False),
    _Panel(
        "both", "gradient", "forward + backward, ms", "error of the gradient, relative L2", False
    ),
    _Panel("both", "gradient", "forward + backward, ms", "the same, under the same cutoff", True),
)


def speed_error_plot(path: Path, points: list[MeasuredVariant], title: str) -> None:
    """Draw milliseconds against error: image, gradient, and what is not due to the cutoff."""
    figure, axes = plt.subplots(1, 3, figsize=(15, 5), layout="constrained")
    knobs = list(dict.fromkeys(p.variant.knob for p in points))
    # Milliseconds of the default's batch: a batch on a slower machine is scaled by the reference.
    reference = points[0].milliseconds["both"] / points[0].ratios["both"]
    for axis, panel in zip(axes, PANELS, strict=True):
        shown = [p for p in points if not panel.numerics or p.numerics is not None]

        def at(p: MeasuredVariant, panel=panel) -> tuple[float, float]:
            error = p.numerics if panel.numerics else p.error
            assert error is not None
            return p.ratios[panel.time] * reference, error[panel.error]

        places = [at(p) for p in shown]
        best = [
            p
            for p, (x, y) in zip(shown, places, strict=True)
            if not any(u < x and v < y for u, v in places)
        ]
        for p, (x, y) in zip(shown, places, strict=True):
            i, star = knobs.index(p.variant.knob), p.variant == DEFAULT
            axis.scatter(
                x,
                y,
                s=190 if star else 42,
                marker="*" if star else MARKERS[i % len(MARKERS)],
                color="black" if star else COLORS[i % len(COLORS)],
                label=p.variant.knob,
                zorder=4 if star else 3,
            )
        _label(axis, [(p.variant.setting, *at(p)) for p in [*best, *shown]])
        line = sorted(at(p) for p in best)
        axis.step(*zip(*line, strict=True), where="post", color="#999999", lw=1, zorder=1)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel(panel.xlabel)
        axis.set_ylabel(panel.ylabel)
        axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(FormatStrFormatter("%g"))
        axis.tick_params(axis="x", which="both", labelsize=7)
        axis.grid(alpha=0.25)
    entries = dict(zip(*reversed(axes[0].get_legend_handles_labels()), strict=True))
    figure.legend(entries.values(), entries.keys(), fontsize=8, loc="outside right upper")
    figure.suptitle(title, fontsize=10)
    _save(path, figure)


def _label(axis, points: list[tuple[str, float, float]]) -> None:
    """Label points in order, skipping labels that would overlap others."""
    x, y = (np.log([p[i] for p in points]) for i in (1, 2))
    x, y = (a - a.min() for a in (x, y))
    x, y = x / max(x.max(), 1e-9), y / max(y.max(), 1e-9)
    taken: list[tuple[float, float]] = []
    for (text, at_x, at_y), u, v in zip(points, x, y, strict=True):
        if text and not any(abs(u - a) < 0.13 and abs(v - b) < 0.04 for a, b in taken):
            taken.append((float(u), float(v)))
            axis.annotate(
                text,
                (at_x, at_y),
                textcoords="offset points",
                xytext=(6, 5),
                fontsize=7,
                color="#333333",
            )


def growth_table(curves: list[GrowthCurve]) -> str:
    """Return every sample of every curve and the fitted exponents."""
    rows = []
    for c in curves:
        for i, s in enumerate(c.samples):
            last = i == len(c.samples) - 1
            rows.append(
                [
                    f"{c.axis} ({c.held} kept)" if i == 0 else "",
                    f"{s.work:g}",
                    f"{s.forward:.1f}",
                    f"{s.both:.1f}",
                    f"{s.entries / 1e3:.0f}k",
                    f"{s.temporaries / 1e6:.0f}",
                    f"{c.forward_exponent:.2f} / {c.both_exponent:.2f}" if last else "",
                    "{:.2f} / {:.2f}".format(*c.last_exponents) if last else "",
                ]
            )
    return markdown(
        [
            "what grows",
            "work",
            "fwd ms",
            "fwd+bwd ms",
            "entries",
            "MB",
            "power",
            "of the last step",
        ],
        rows,
    )


def memory_coefficients(curves: list[GrowthCurve]) -> dict[str, float]:
    """Return bytes of temporaries per Gaussian, pixel and entry (non-negative least squares)."""
    from scipy.optimize import nnls

    rows, bytes_ = [], []
    for c in curves:
        for s in c.samples:
            if c.axis == "views in one program":
                continue
            pixels = s.work if c.axis == "pixels" else 960 * 650
            count = s.work if c.axis.startswith("Gaussians") else 100_000
            rows.append([count, pixels, s.entries])
            bytes_.append(s.temporaries)
    matrix, target = np.asarray(rows, float), np.asarray(bytes_, float)
    # Relative residuals, so that the largest scene does not decide alone.
    solution, _ = nnls(matrix / target[:, None], np.ones(len(target)))
    return dict(zip(("Gaussian", "pixel", "entry"), map(float, solution), strict=True))


def growth_plot(path: Path, curves: list[GrowthCurve]) -> None:
    """Draw every curve in log-log."""
    figure, axes = plt.subplots(1, len(curves), figsize=(3.1 * len(curves), 3), sharey=True)
    for axis, c in zip(axes, curves, strict=True):
        work = [s.work for s in c.samples]
        for label, times, p, marker in (
            ("forward", [s.forward for s in c.samples], c.forward_exponent, "o"),
            ("forward + backward", [s.both for s in c.samples], c.both_exponent, "s"),
        ):
            axis.loglog(work, times, marker=marker, label=f"{label}: power {p:.2f}")
        axis.set_xlabel(c.axis, fontsize=8)
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25)
        axis.legend(fontsize=7)
    axes[0].set_ylabel("ms")
    figure.tight_layout()
    _save(path, figure)


def memory_table(sizes: list[Footprint]) -> str:
    """Return resident memory and times."""
    rows = [
        [
            f"{f.gaussians:,} at {f.width}x{f.height}",
            f"{f.entries / 1e3:.0f}k",
            *(f"{v:.0f}" for v in (f.runtime, f.compiling, f.forward, f.both, f.temporaries)),
            f"{f.forward_ms:.0f} / {f.both_ms:.0f}",
        ]
        for f in sizes
    ]
    header = ["scene", "entries", "JAX alone MB", "compiling", "forward", "fwd+bwd"]
    return markdown([*header, "of it buffers", "ms fwd / fwd+bwd"], rows)


def implementations_table(timings: list[Timing]) -> str:
    """Return times, memory and errors of every rasterizer, and ratios to gsplat where it ran."""
    rival = {t.scene: t.both for t in timings if t.implementation == "gsplat"}
    rows = [
        [
            t.scene,
            t.implementation,
            f"{t.forward:.2f}",
            f"{t.both:.2f}",
            f"{t.both / rival[t.scene]:.2f}" if t.scene in rival else "n/a",
            f"{t.megabytes:.0f}",
            *(_number(k, t.error[k]) if k in t.error else "n/a" for k in ACCURACY),
        ]
        for t in timings
    ]
    header = ["scene", "rasterizer", "fwd ms", "fwd+bwd ms", "of gsplat's", "MB"]
    return markdown([*header, *(METRICS[k].title for k in ACCURACY)], rows)


def work_table(works: list[Work]) -> str:
    """Return what each view asks of the device."""
    rows = [
        [
            w.scene,
            f"{w.entries / 1e3:.0f}k",
            f"{w.pairs / 1e6:.0f}M",
            *(f"{v:.2f}" for v in (*w.gigaflops, *w.gigabytes)),
        ]
        for w in works
    ]
    header = ["scene", "entries", "pairs", "GFLOP fwd", "fwd+bwd", "GB fwd", "fwd+bwd"]
    return markdown(header, rows)


def step_table(costs: dict[str, StepCost]) -> str:
    """Return milliseconds of a step, part by part."""
    names = list(next(iter(costs.values())).parts)
    rows = [
        [scene, *(f"{c.parts[n]:.1f}" for n in names), f"{c.whole:.1f}", str(c.compilations)]
        for scene, c in costs.items()
    ]
    return markdown(["scene", *names, "whole step", "programs"], rows)


def levels_table(levels: list[Level]) -> str:
    """Return what every level of a fit asks of the renderer, and what it takes."""
    rows = []
    for level in levels:
        lists, ms = level.lists, level.milliseconds
        low, middle, high = lists.quantiles
        numerics = (
            _number(k, level.numerics[k]) if k in level.numerics else "" for k in LEVEL_ACCURACY
        )
        rows.append(
            [
                level.scene,
                "{}x{}".format(*level.size),
                f"{level.gaussians / 1e3:.0f}k",
                f"{lists.entries / 1e3:.0f}k",
                f"{lists.entries / lists.tiles:.0f}",
                f"{low:.0f} / {middle:.0f} / {high:.0f}",
                str(lists.longest),
                *(f"{ms[k]:.1f}" if k in ms else "" for k in ("forward", "both", "step")),
                *numerics,
            ]
        )
    header = ["scene", "pixels", "Gaussians", "entries", "a tile", "5 / 50 / 95 %", "longest"]
    header += ["fwd ms", "fwd+bwd ms", "step ms", *(METRICS[k].title for k in LEVEL_ACCURACY)]
    return markdown(header, rows)


def hard_case_table(gaps: dict[str, Gap]) -> str:
    """Return every hard case, what must happen, and how far float32 is from float64."""
    rows = []
    for case in CASES:
        g = gaps[case.name]
        rows.append(
            [
                f"{case.name}: {case.expect}",
                f"{g.value:.1e}",
                f"{g.gradient:.1e}",
                str(g.undecided),
                "zero" if g.silent else "finite" if g.finite else "NOT FINITE",
            ]
        )
    return markdown(["case", "image", "gradient", "undecided pairs", "values"], rows)


def _save(path: Path, figure) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
    plt.close(figure)
