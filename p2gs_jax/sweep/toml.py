"""A sweep described by a file.

    scene = "street"
    reference = "street/reference"      # paths are relative to the file
    out = "runs/sweep"
    preset = "robust"
    seeds = [0, 1, 2]
    max_parallel = 1

    [set]                               # for all
    "train.steps" = 600

    [grid]                              # every combination
    "loss.relative_exposure.weight" = ["none", 0.01]

    [[case]]                            # and single ones
    name = "paper"
    preset = "paper"
    "densify.max_gaussians" = 30000

TOML has no null: "none" stands for it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig, preset
from p2gs_jax.errors import UserError
from p2gs_jax.sweep.fields import product, with_fields

KEYS = ("scene", "reference", "out", "preset", "seeds", "max_parallel", "set", "grid", "case")


@dataclass(frozen=True)
class SweepFile:
    """Contents of the file; see `sweep`."""

    scene: Path
    out: Path
    configs: dict[str, FitConfig]
    seeds: tuple[int, ...]
    reference: Path | None
    max_parallel: int


def read_sweep(path: Path) -> SweepFile:
    """Read the file.

    Raises:
        UserError: it is missing or no TOML, a key or a field is unknown, or a value is wrong.
    """
    try:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(
            f"{path} cannot be read: {error.strerror}.",
            fix="name a TOML file; docs/sweeps.md shows one",
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(
            f"{path} is no TOML: {error}.", fix="mend that line; docs/sweeps.md shows an example"
        ) from error
    unknown = [key for key in data if key not in KEYS]
    if unknown:
        raise UserError(f"{path}: unknown key {unknown[0]!r}.", fix=f"known: {', '.join(KEYS)}")
    if "scene" not in data:
        raise UserError(f"{path} names no scene.", fix='add scene = "FOLDER"')
    seeds, parallel = data.get("seeds", [0]), data.get("max_parallel", 1)
    if not isinstance(seeds, list) or not all(type(s) is int for s in seeds):
        raise UserError(f"{path}: seeds = {seeds!r}.", fix="write whole numbers, as in [0, 1, 2]")
    if type(parallel) is not int:
        raise UserError(f"{path}: max_parallel = {parallel!r}.", fix="write a whole number")
    folder = Path(path).parent
    common = _nulls(data.get("set", {}))
    base = with_fields(_preset(data.get("preset", "robust"), path), common)
    axes = {k: [_null(v) for v in values] for k, values in data.get("grid", {}).items()}
    cases = data.get("case", [])
    configs = product(base, axes) if axes or not cases else {}
    for number, case in enumerate(cases, 1):
        fields = dict(_nulls(case))
        name = str(fields.pop("name", f"case {number}"))
        if name in configs:
            raise UserError(
                f"{path}: two configurations are called {name!r}.", fix="give each case its name"
            )
        start = fields.pop("preset", data.get("preset", "robust"))
        configs[name] = with_fields(with_fields(_preset(start, path), common), fields)
    reference = data.get("reference")
    return SweepFile(
        scene=folder / data["scene"],
        out=folder / data.get("out", Path(path).stem),
        configs=configs,
        seeds=tuple(seeds),
        reference=None if reference is None else folder / reference,
        max_parallel=parallel,
    )


def _preset(name: Any, path: Path) -> FitConfig:
    try:
        return preset(name)
    except UserError as error:
        raise UserError(f"{path}: {error.message}", fix=error.fix) from None


def _null(value: Any) -> Any:
    return None if value == "none" else value


def _nulls(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _null(value) for name, value in fields.items()}
