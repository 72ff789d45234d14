"""Benchmarks of the renderer: milliseconds against error, and the levels of a fit.

python benchmarks/run.py --quick
python benchmarks/run.py speed_error levels --quick --baseline experiments/bench/baseline.json
python benchmarks/run.py levels --set chunk=32 --out runs/bench

OUT/bench.md gets the tables, OUT/bench.json the numbers. The exit code is 1 if a value is worse
than the baseline allows, and 2 if an argument is not valid. Tests use `hard_cases`.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import platform
import sys
from ast import literal_eval
from collections.abc import Sequence
from pathlib import Path

import jax

# The folder `benchmarks` is importable from any working folder.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import gate, levels, speed_error
from p2gs_jax.config import RenderConfig
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.errors import UserError
from p2gs_jax.presets import preset

PARTS = ("speed_error", "levels")


def stamp() -> dict:
    """Return the machine and versions on which the numbers depend."""
    return {
        "jax": jax.__version__,
        "backend": jax.default_backend(),
        "device": jax.devices()[0].device_kind,
        "architecture": platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
    }


def section(title: str, header: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table with its title; the first column is left-aligned, others right."""
    lines = ["| " + " | ".join(r) + " |" for r in (header, *rows)]
    return "\n".join([f"## {title}\n", lines[0], "|---|" + "---:|" * (len(header) - 1), *lines[1:]])


def run(options: argparse.Namespace, on_progress) -> tuple[str, list[str]]:
    """Run the chosen parts and write `bench.md` and `bench.json`.

    Returns:
        The tables as Markdown, and a sentence for each value worse than the baseline allows.

    Raises:
        UserError: the baseline cannot be used.
    """
    parts, quick = options.parts or PARTS, options.quick
    variants = speed_error.QUICK if quick else speed_error.VARIANTS
    fits = levels.QUICK if quick else levels.SCENES
    render = dataclasses.replace(RenderConfig(), **dict(options.set))
    cfg = dataclasses.replace(preset("robust"), render=render)

    def of_variants(chosen: Sequence[speed_error.Variant]) -> list[speed_error.MeasuredVariant]:
        scene = speed_error.sweep_scene(quick)
        return speed_error.measure_speed_error(scene, chosen, on_progress=on_progress)

    def of_levels(names: Sequence[str]) -> list[levels.Level]:
        return levels.measure_levels(
            {k: fits[k] for k in names},
            cfg,
            steps=levels.QUICK_STEPS if quick else None,
            repeats=5 if quick else 7,
            on_progress=on_progress,
        )

    sections: list[str] = []
    data: dict = {"stamp": stamp(), "quick": quick}
    complaints: list[str] = []
    gated: gate.Rows = {}
    if "speed_error" in parts:
        points = of_variants(variants)
        sections.append(section("Speed against error", *speed_error.table(points)))
        data["speed_error"] = [p._asdict() | {"variant": p.variant.name} for p in points]
        gated |= speed_error.gate_rows(points)
    if "levels" in parts:
        measured = of_levels(list(fits))
        title = "Levels of a fit: rendering and the whole step"
        sections.append(section(title, *levels.table(measured)))
        data["levels"] = [level._asdict() | {"lists": level.lists._asdict()} for level in measured]
        gated |= levels.gate_rows(measured)
    if options.write_baseline:
        gate.write_baseline(options.write_baseline, gated)
    if options.baseline:

        def measure(names: list[str]) -> gate.Rows:
            slow = [v for v in variants if v.name in names]
            rows = speed_error.gate_rows(of_variants(slow)) if slow else {}
            return rows | levels.gate_rows(of_levels([k for k in names if k in fits]))

        complaints = gate.settle(options.baseline, gated, measure)
    text = "\n\n".join(sections) + "\n"
    write_text(options.out / "bench.md", text)
    write_json(options.out / "bench.json", data)
    return text, complaints


def _field(text: str) -> tuple[str, object]:
    name, _, value = text.partition("=")
    if name not in {f.name for f in dataclasses.fields(RenderConfig)}:
        raise argparse.ArgumentTypeError(f"RenderConfig has no field {name!r}")
    try:
        return name, literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def options_of(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the parsed arguments; arguments that are not valid exit with code 2."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("parts", nargs="*", help=f"{', '.join(PARTS)}; default: all", metavar="PART")
    add("--out", type=Path, default=Path("runs/bench"), help="folder for tables and numbers")
    add("--quick", action="store_true", help="fewer and smaller scenes: 2 instead of 30 minutes")
    add("--baseline", type=Path, help="compare speed_error and levels with this file")
    add("--write-baseline", type=Path, help="write the values of speed_error and levels to a file")
    add(
        "--set",
        type=_field,
        action="append",
        default=[],
        metavar="FIELD=VALUE",
        help="an option of the renderer (p2gs_jax.config.RenderConfig), for levels",
    )
    options = parser.parse_args(arguments)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"{unknown.pop()!r} is not a valid part; choose {', '.join(PARTS)}")
    if options.baseline and not options.baseline.is_file():
        parser.error(f"the file {options.baseline} does not exist: write one with --write-baseline")
    return options


def main() -> int:
    """Run, print the tables, return the exit code."""
    options = options_of()
    try:
        with TerminalReporter() as reporter:
            text, complaints = run(options, reporter.stage)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    print(text)
    print(f"Results: {options.out}")
    for complaint in complaints:
        print(f"WORSE than {options.baseline}: {complaint}")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
