"""Configurations by dotted field names: single ones, grids, and sweeps in TOML files."""

from __future__ import annotations

import dataclasses
import itertools
import tomllib
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.errors import UserError
from p2gs_jax.presets import preset, with_values

TEXT, NUMBER, TABLE = "write text in quotes", "write a whole number", "write it as a table"
# Keys of a sweep file: the type of each value, and the remedy if it has another.
KEYS = {
    **dict.fromkeys(("scene", "reference", "out", "preset"), (str, TEXT)),
    "seeds": (list, "write whole numbers, as in [0, 1, 2]"),
    "max_parallel": (int, NUMBER),
    **dict.fromkeys(("set", "grid"), (dict, TABLE)),
    "case": (list, "write [[case]] above each configuration"),
}


def with_fields(cfg: FitConfig, fields: Mapping[str, Any]) -> FitConfig:
    """Return the configuration with the values of some dotted fields replaced.

    Raises a UserError if a field (such as `loss.relative_exposure.weight`) does not exist, or if
    its value is not valid.
    """
    return with_values(cfg, {name: _checked(cfg, name, value) for name, value in fields.items()})


def _checked(cfg: FitConfig, whole: str, value: Any) -> Any:
    """Return a value with the type of the field: lists become tuples, integers floats if needed."""
    record, last, found = None, "", cfg
    why = f"{whole!r} is not a configuration field."
    for name in whole.split("."):
        if not dataclasses.is_dataclass(found):
            raise UserError(why, fix=f"{last!r} is a value: leave out the names after it")
        names = [f.name for f in dataclasses.fields(found)]
        if name not in names:
            raise UserError(why, fix=f"instead of {name!r} use one of: {', '.join(names)}")
        record, last, found = found, name, getattr(found, name)
    hint = typing.get_type_hints(type(record))[last]
    value = tuple(value) if isinstance(value, list) else value
    if not _fits(value, hint):
        value = tuple(map(_float, value)) if isinstance(value, tuple) else _float(value)
    if not _fits(value, hint):
        raise UserError(f"{whole} = {value!r} is not valid.", fix=f"write {_allowed(hint)}")
    return value


def _float(value: Any) -> Any:
    return float(value) if type(value) is int else value


def _fits(value: Any, hint: Any) -> bool:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return value in args
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, a) for a in args)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if len(args) == 2 and args[1] is Ellipsis:
            return all(_fits(v, args[0]) for v in value)
        return len(value) == len(args) and all(map(_fits, value, args))
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, hint)


def _allowed(hint: Any) -> str:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return ", ".join(repr(a) for a in args)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_allowed(a) for a in args)
    if origin is tuple:
        return f"[{', '.join('...' if a is Ellipsis else _allowed(a) for a in args)}]"
    if hint is type(None):
        return '"none"'
    return hint.__name__ if isinstance(hint, type) and not args else str(hint)


def grid(base: FitConfig, **axes: Sequence[Any]) -> dict[str, FitConfig]:
    """Return every combination of the values of some fields, by a name that lists them.

    All other fields are as in `base`. Double underscores stand for dots in the names of `axes`,
    as in `loss__relative_exposure__weight=[0.01, 0.1]`. Errors are as in `with_fields`.
    """
    return _product(base, {name.replace("__", "."): values for name, values in axes.items()})


def _product(base: FitConfig, axes: Mapping[str, Sequence[Any]]) -> dict[str, FitConfig]:
    out = {}
    for values in itertools.product(*axes.values()):
        chosen = dict(zip(axes, values, strict=True))
        name = ", ".join(f"{field.split('.')[-1]} {value}" for field, value in chosen.items())
        out[name or "base"] = with_fields(base, chosen)
    return out


@dataclass(frozen=True)
class SweepFile:
    """The arguments of `sweep` from a file."""

    scene: Path
    out: Path
    configs: dict[str, FitConfig]
    seeds: tuple[int, ...]
    reference: Path | None
    max_parallel: int


def read_sweep(path: Path) -> SweepFile:
    """Read a TOML file that describes a sweep.

        scene = "street"
        reference = "street/reference"      # paths are relative to the file
        out = "runs/sweep"
        preset = "robust"
        seeds = [0, 1, 2]
        max_parallel = 1

        [set]                               # for all configurations
        "train.steps" = 600

        [grid]                              # every combination
        "loss.relative_exposure.weight" = ["none", 0.01]

        [[case]]                            # a single configuration
        name = "paper"
        preset = "paper"
        "densify.max_gaussians" = 30000

    TOML has no null: "none" stands for it. UserError: the file is missing or not TOML, a key or a
    field is unknown, or a value is not valid.
    """
    data = _parsed(Path(path))
    folder, reference = Path(path).parent, data.get("reference")
    return SweepFile(
        scene=folder / data["scene"],
        out=folder / data.get("out", Path(path).stem),
        configs=_configs(data, path),
        seeds=tuple(data.get("seeds", [0])),
        reference=None if reference is None else folder / reference,
        max_parallel=data.get("max_parallel", 1),
    )


def _parsed(path: Path) -> dict[str, Any]:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        fix = "name a TOML file; docs/api.md shows one"
        raise UserError(f"{path} cannot be read: {error.strerror}.", fix=fix) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        fix = "correct that line; docs/api.md shows an example"
        raise UserError(f"{path} is not valid TOML: {error}.", fix=fix) from error
    unknown = [key for key in data if key not in KEYS]
    if unknown:
        raise UserError(f"{path}: unknown key {unknown[0]!r}.", fix=f"known: {', '.join(KEYS)}")
    if "scene" not in data:
        raise UserError(f"{path} does not name a scene.", fix='add scene = "FOLDER"')
    for key, value in data.items():
        kind, fix = KEYS[key]
        items = {"seeds": int, "case": dict}.get(key)
        if type(value) is not kind or (items and any(type(item) is not items for item in value)):
            raise UserError(f"{path}: {key} = {value!r} is not valid.", fix=fix)
    for name, values in data.get("grid", {}).items():
        if not isinstance(values, list):
            fix = f'write the name in quotes and its values as a list: "{name}" = [VALUE, ...]'
            raise UserError(f"{path}: [grid] {name} = {values!r} is not a list.", fix=fix)
    return data


def _configs(data: Mapping[str, Any], path: Path) -> dict[str, FitConfig]:
    """Return the configurations of a file: first its grid, then its single cases."""

    def start(name: Any) -> FitConfig:
        try:
            return with_fields(preset(name), common)
        except UserError as error:
            raise UserError(f"{path}: {error.message}", fix=error.fix) from None

    common = _nulls(data.get("set", {}))
    usual, cases = data.get("preset", "robust"), data.get("case", [])
    axes = {k: list(_nulls(dict(enumerate(v))).values()) for k, v in data.get("grid", {}).items()}
    configs = _product(start(usual), axes) if axes or not cases else {}
    for number, case in enumerate(cases, 1):
        fields = _nulls(case)
        name = str(fields.pop("name", f"case {number}"))
        if name in configs:
            fix = "give each case a different name"
            raise UserError(f"{path}: two configurations have the name {name!r}.", fix=fix)
        configs[name] = with_fields(start(fields.pop("preset", usual)), fields)
    return configs


def _nulls(fields: Mapping[Any, Any]) -> dict[Any, Any]:
    return {name: None if value == "none" else value for name, value in fields.items()}
