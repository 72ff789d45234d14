"""Shared by the tables: three towns, the methods under one budget, and their runs.

Every town is photographed at ISO 8 throughout (ISO-Const), and with ISO drawn about 8 with standard
deviation 2 and 4 (paper, appendix "Exposure Control"); geometry and cameras are the same. All
methods get the same renderer, seeds, steps and bound on Gaussians. Runs are kept in the output
folder and shared between tables; run a script again to continue.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from checkout import commit

import p2gs_jax
from p2gs_jax.config import FitConfig, PresetName
from p2gs_jax.core.text import value_at
from p2gs_jax.jobs.sweep import sweep
from p2gs_jax.presets import to_dict
from p2gs_jax.synth.sensor import Sensor
from p2gs_jax.synth.settings import image_height

CONSTANT, NARROW, WIDE = 0.0, 2.0, 4.0
STD_NAMES = {CONSTANT: "ISO-Const", NARROW: "ISO std 2", WIDE: "ISO std 4"}


@dataclass(frozen=True)
class Protocol:
    """Size and budget of everything in a table."""

    towns: tuple[int, ...] = (0, 1, 2)
    frames: int = 20
    width: int = 160
    step_m: float = 1.2
    points: int = 8000
    steps: int = 600
    # None: as many as the preset thinks right.
    gaussians: int | None = 10_000

    @property
    def data(self) -> str:
        """Folder of its towns."""
        return f"{self.width}x{image_height(self.width)}_{self.frames}x3"

    @property
    def name(self) -> str:
        """Folder of its runs and tables."""
        return f"{self.data}_{self.steps}"


FULL = Protocol()
QUICK = Protocol(towns=(0,), frames=6, width=128, points=3000, steps=150, gaussians=4000)

# Presets by the names that the paper's tables use.
METHODS: dict[str, PresetName] = {
    "3DGS": "3dgs",
    "3DGS + gain": "3dgs_gain",
    "3DGS + AT": "3dgs_affine",
    "3DGS + bilateral grid": "3dgs_bilateral",
    "3DGS + curve": "3dgs_curve",
    "Luminance-GS": "luminance_gs",
    "PPISP": "ppisp",
    "P2GS as printed": "paper",
    "P2GS, appendix weights": "paper_appendix",
    "robust (ours)": "robust",
}
WITH_EXPOSURES = frozenset({"P2GS as printed", "P2GS, appendix weights", "robust (ours)"})
NOT_BUILT = """Not built here: Difix3D needs its diffusion weights; PVG, StreetGS, OmniRe and
DeSIRE-GS are dynamic systems (these towns stand still). Luminance-GS is the preset `luminance_gs`,
its curve per view under our renderer; `3DGS + curve` has a monotone curve per view."""

# A column of a table: its title, where metrics.json has its value, digits shown.
Column = tuple[str, tuple[str, ...], int]
# Where metrics.json has the scores against photographs at one common exposure.
ISO8 = ("reference", "scale_aligned")
EV_ERROR: Column = ("EV error", ("ev",), 4)


@dataclass(frozen=True)
class Options:
    """The options of the command line."""

    out: Path
    protocol: Protocol
    max_parallel: int
    lpips_weights: str | None
    command: str

    @property
    def folder(self) -> Path:
        """Where the protocol's runs and tables are."""
        return self.out / self.protocol.name


def options(description: str | None, command: str, argv: Sequence[str] | None = None) -> Options:
    """Parse the options that all tables have; None: of the command line."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("runs/paper"))
    parser.add_argument("--towns", type=int, nargs="+")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--quick", action="store_true", help="one small town, few steps")
    parser.add_argument("--max-parallel", type=int, default=1, help="fits at a time")
    parser.add_argument("--lpips-weights", help="alex or vgg; without them LPIPS is n/a")
    args = parser.parse_args(argv)
    protocol = QUICK if args.quick else FULL
    if args.towns:
        protocol = dataclasses.replace(protocol, towns=tuple(args.towns))
    if args.steps:
        protocol = dataclasses.replace(protocol, steps=args.steps)
    command = f"python experiments/{command}"
    for flag in ("towns", "steps", "quick"):
        value = getattr(args, flag)
        if value:
            shown = "" if value is True else " " + " ".join(map(str, np.atleast_1d(value)))
            command += f" --{flag}{shown}"
    return Options(args.out, protocol, args.max_parallel, args.lpips_weights, command)


def scene(o: Options, town: int, std: float) -> Path:
    """Return a town's folder; it is made where it does not exist."""
    return photographed(o, town, f"iso{std:g}", Sensor(iso_std=std))


def photographed(o: Options, town: int, name: str, sensor: Sensor) -> Path:
    """Return the folder of a town as a sensor sees it; it is made where it does not exist."""
    p = o.protocol
    path = o.out / "towns" / p.data / f"town_{town}_{name}"
    if not path.exists():
        p2gs_jax.write_street(
            path,
            frames=p.frames,
            width=p.width,
            height=image_height(p.width),
            step=p.step_m,
            points=p.points,
            sensor=sensor,
            seed=town,
            layout="town",
        )
    return path


def budgeted(cfg: FitConfig, o: Options) -> FitConfig:
    """Return a configuration under the protocol's budget."""
    p, densify = o.protocol, cfg.densify
    if p.gaussians is not None:
        densify = dataclasses.replace(densify, max_gaussians=p.gaussians)
    evaluation = dataclasses.replace(cfg.evaluation, lpips_weights=o.lpips_weights)
    train = dataclasses.replace(cfg.train, steps=p.steps)
    return dataclasses.replace(cfg, train=train, densify=densify, evaluation=evaluation)


def methods(names: Sequence[str] | None = None) -> dict[str, FitConfig]:
    """Return the compared methods, or some of them."""
    return {name: p2gs_jax.preset(METHODS[name]) for name in names or METHODS}


@dataclass(frozen=True)
class Runs:
    """Finished runs by (method, ISO std, town).

    Attributes:
        metrics: what their metrics.json say, and exposure errors.
        folders: where they are.
        failures: those that did not finish, with reasons.
        configs: what each method was fitted under.
    """

    metrics: dict[tuple[str, float, int], dict[str, Any]]
    folders: dict[tuple[str, float, int], Path]
    failures: tuple[str, ...]
    configs: dict[str, dict] = field(default_factory=dict)

    def mean(self, method: str, std: float, *path: str) -> float:
        """Return the mean over towns of a value of metrics.json; NaN where none has it."""
        runs = [m for (a, s, _), m in self.metrics.items() if (a, s) == (method, std)]
        values = [v for v in (value_at(m, path) for m in runs) if v is not None]
        return float(np.mean(values)) if values else float("nan")

    def cells(self, method: str, std: float, columns: Sequence[Column]) -> list[str]:
        """Return a method's means in these columns."""
        return [number(self.mean(method, std, *path), digits) for _, path, digits in columns]

    def ev_error(self, method: str, std: float) -> str:
        """Return the cell of EV_ERROR; empty without exposures or without a spread of ISO."""
        known = std != CONSTANT and method in WITH_EXPOSURES
        return self.cells(method, std, [EV_ERROR])[0] if known else ""


def fit_all(o: Options, wanted: Mapping[float, Mapping[str, FitConfig]]) -> Runs:
    """Fit every method of every ISO std to every town; finished fits are kept.

    Args:
        o: protocol and folder.
        wanted: ISO std -> method -> configuration, before the budget is applied.
    """
    metrics, folders, failures, used = {}, {}, [], {}
    for town in o.protocol.towns:
        for std, configs in wanted.items():
            street = scene(o, town, std)
            under = {name: budgeted(cfg, o) for name, cfg in configs.items()}
            used |= {name: to_dict(cfg) for name, cfg in under.items()}
            result = sweep(
                street,
                o.folder / street.name,
                under,
                reference=street / "reference",
                max_parallel=o.max_parallel,
                report=lambda line, s=street: print(f"{s.name} {line}", flush=True),
            )
            for row in result.rows:
                key = (row["name"], std, town)
                if row["status"] != "done":
                    failures.append(f"{row['name']}, {street.name}: {row['reason']}")
                    continue
                folders[key] = Path(row["run"])
                found = json.loads((folders[key] / "metrics.json").read_text())
                metrics[key] = found | {"ev": row.get("ev"), "ev_power": row.get("ev_power")}
    return Runs(metrics, folders, tuple(failures), used)


def number(value: float, digits: int) -> str:
    """Return a cell; n/a stands for a missing value."""
    return "n/a" if not np.isfinite(value) else f"{value:.{digits}f}"


def titles(columns: Sequence[tuple[str, Any, int]]) -> tuple[str, ...]:
    """Return the part of the header on these columns."""
    return tuple(title for title, _, _ in columns)


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table, first column to the left."""
    lines = ["| " + " | ".join(header) + " |", "|---|" + "---:|" * (len(header) - 1)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def stamp(o: Options, seconds: float) -> dict[str, Any]:
    """Return where a table comes from."""
    return {
        "command": o.command,
        "date": datetime.date.today().isoformat(),
        "commit": commit(),
        "protocol": dataclasses.asdict(o.protocol),
        "seed": 0,
        "seconds_of_this_call": round(seconds, 1),
    }


def write(
    o: Options, name: str, markdown: str, runs: Runs, begin: float, extra: dict | None = None
) -> None:
    """Print a table and write it beside its numbers and where they come from."""
    said = stamp(o, time.monotonic() - begin)
    if runs.failures:
        markdown += "\nNot finished:\n\n" + "".join(f"- {line}\n" for line in runs.failures)
    o.folder.mkdir(parents=True, exist_ok=True)
    rows = [
        {"method": m, "iso_std": s, "town": t, **_scalars(v)}
        for (m, s, t), v in runs.metrics.items()
    ]
    payload = {"stamp": said, "rows": rows, "configs": runs.configs, **(extra or {})}
    (o.folder / f"{name}.json").write_text(json.dumps(payload, indent=1) + "\n")
    p = o.protocol
    budget = "" if p.gaussians is None else f", at most {p.gaussians} Gaussians"
    foot = (
        f"\n{len(p.towns)} town(s), {3 * p.frames} photographs of "
        f"{p.width}x{image_height(p.width)} each, {p.steps} steps{budget}. "
        f"`{said['command']}`, {said['date']}, commit {said['commit']}.\n"
    )
    (o.folder / f"{name}.md").write_text(markdown + foot)
    print(markdown + foot)


def _scalars(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return metrics without their rows per view."""
    return {
        k: _scalars(v) if isinstance(v, Mapping) else v
        for k, v in values.items()
        if k not in ("per_view", "notes", "per_camera")
    }
