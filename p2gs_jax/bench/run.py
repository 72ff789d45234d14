"""`p2gs-jax bench`: every bench, its tables, pictures and the gate."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, get_args

from p2gs_jax.bench import (
    gate,
    growth,
    hard_cases,
    implementations,
    levels,
    memory,
    report,
    speed_error,
)
from p2gs_jax.bench.scenes import BenchScene, street
from p2gs_jax.bench.step import measure_step
from p2gs_jax.config import RenderConfig, preset
from p2gs_jax.core.atomic import write_json, write_text

Part = Literal["speed_error", "levels", "growth", "memory", "step", "hard_cases", "implementations"]
PARTS: tuple[Part, ...] = get_args(Part)
# What a baseline holds.
GATED: tuple[Part, ...] = ("speed_error", "levels")
Progress = Callable[[str, int, int], None]


def sweep_scene(quick: bool) -> BenchScene:
    """Return the scene of `speed_error`: a street, degree 3, about five stops of contrast."""
    if quick:
        return street(4000, 256, 144, radius=6.0, degree=3)
    return street(20_000, 640, 360, radius=4.0, spread=1.1, degree=3)


def run(
    parts: tuple[Part, ...] = PARTS,
    *,
    out: Path,
    quick: bool = False,
    baseline: Path | None = None,
    write_baseline: Path | None = None,
    render: RenderConfig | None = None,
    on_progress: Progress = lambda stage, done, count: None,
) -> tuple[str, list[str]]:
    """Run benches and write `bench.md`, `bench.json` and plots under `out`.

    Args:
        parts: which.
        out: folder.
        quick: fewer and smaller.
        baseline: compare `speed_error` and `levels` with it.
        write_baseline: write what these measured there.
        render: options of the renderer for `levels`; default `RenderConfig()`.
        on_progress: called with (stage, done, count).

    Returns:
        The tables as Markdown, and what is worse than the baseline allows.
    """
    sections: list[str] = []
    data: dict = {"stamp": report.stamp(), "quick": quick}
    complaints: list[str] = []
    gated: gate.Rows = {}

    def section(title: str, *texts: str) -> None:
        sections.append("\n\n".join([f"## {title}", *texts]))

    def of_variants(variants: Sequence[speed_error.Variant]) -> list[speed_error.MeasuredVariant]:
        return speed_error.measure_speed_error(
            sweep_scene(quick), tuple(variants), on_progress=on_progress
        )

    def of_levels(fits: dict[str, Callable[[], BenchScene]]) -> list[levels.Level]:
        return levels.measure_levels(
            fits,
            dataclasses.replace(preset("robust"), render=render or RenderConfig()),
            steps=levels.QUICK_STEPS if quick else None,
            repeats=5 if quick else 7,
            on_progress=on_progress,
        )

    variants = speed_error.QUICK if quick else speed_error.VARIANTS
    fits = levels.QUICK if quick else levels.SCENES
    if "speed_error" in parts:
        points = of_variants(variants)
        scene = sweep_scene(quick)
        camera = scene.camera
        title = f"{scene.gaussians.capacity} Gaussians, {camera.width}x{camera.height}, SH degree 3"
        section(f"Speed against error: {title}", report.speed_error_table(points))
        report.speed_error_plot(out / "speed_error.png", points, title)
        data["speed_error"] = [p._replace(variant=p.variant.name)._asdict() for p in points]  # pyright: ignore[reportArgumentType]
        gated |= gate.values(points)
    if "levels" in parts:
        found = of_levels(fits)
        section("Levels of a fit: rendering and the whole step", report.levels_table(found))
        data["levels"] = [level._replace(lists=level.lists._asdict())._asdict() for level in found]  # pyright: ignore[reportArgumentType]
        gated |= levels.gate_rows(found)
    if write_baseline:
        gate.write_baseline(write_baseline, gated)
    if baseline:

        def anew(names: list[str]) -> gate.Rows:
            slow = [v for v in variants if v.name in names]
            rows = gate.values(of_variants(slow)) if slow else {}
            return rows | levels.gate_rows(of_levels({k: fits[k] for k in names if k in fits}))

        complaints = gate.settle(baseline, gated, anew)
    if "growth" in parts:
        curves = growth.measure_growth(quick=quick, on_progress=on_progress)
        per = report.memory_coefficients(curves)
        line = "Buffers of forward + backward, bytes: " + ", ".join(
            f"{v:.0f} per {k}" for k, v in per.items()
        )
        section("Growth", report.growth_table(curves), line + ".")
        report.growth_plot(out / "growth.png", curves)
        data["growth"] = [
            c._replace(samples=[s._asdict() for s in c.samples])._asdict()  # pyright: ignore[reportArgumentType]
            for c in curves
        ]
        data["bytes_per"] = per
    if "memory" in parts:
        sizes = memory.SIZES[:2] if quick else memory.SIZES
        prints = []
        for i, size in enumerate(sizes):
            on_progress("memory", i, len(sizes))
            prints.append(memory.footprint(*size))
        section("Memory: peak resident, a process each", report.memory_table(prints))
        data["memory"] = [f._asdict() for f in prints]
    if "step" in parts:
        scenes = {
            "20k at 640x360": street(20_000, 640, 360, radius=4.0, spread=1.1, degree=3),
            "100k at 960x650": street(100_000, 960, 650, degree=3),
        }
        costs = {}
        for i, (name, scene) in enumerate(list(scenes.items())[: 1 if quick else 2]):
            on_progress("step", i, len(scenes))
            costs[name] = measure_step(scene, preset("robust"))
        section("A step, part by part, milliseconds", report.step_table(costs))
        data["step"] = {k: c._asdict() for k, c in costs.items()}
    if "hard_cases" in parts:
        gaps = {}
        for i, case in enumerate(hard_cases.CASES):
            on_progress("hard cases", i, len(hard_cases.CASES))
            gaps[case.name] = hard_cases.gap(case, hard_cases.CONFIG)
        section("Hard cases: float32 against float64", report.hard_case_table(gaps))
        data["hard_cases"] = {k: g._asdict() for k, g in gaps.items()}
    if "implementations" in parts:
        timings, works = implementations.measure_implementations(
            quick=quick, on_progress=on_progress
        )
        counted = "Work of compositing tile by tile, counted:"
        tables = report.implementations_table(timings), counted, report.work_table(works)
        section("Rasterizers on this device", *tables)
        data["implementations"] = [t._asdict() for t in timings]
        data["work"] = [w._asdict() for w in works]
    text = "\n\n".join(sections) + "\n"
    write_text(out / "bench.md", text)
    write_json(out / "bench.json", data)
    return text, complaints
