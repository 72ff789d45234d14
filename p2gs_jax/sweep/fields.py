"""Configuration fields by their dotted names, with checks of their values."""

from __future__ import annotations

import dataclasses
import itertools
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.errors import UserError


def with_fields(cfg: FitConfig, fields: Mapping[str, Any]) -> FitConfig:
    """Return the configuration with some fields replaced.

    Args:
        cfg: to start from.
        fields: dotted names (`loss.relative_exposure.weight`) and values.

    Raises:
        UserError: there is no such field, or the value is none of those it takes.
    """
    for name, value in fields.items():
        cfg = _replaced(cfg, name.split("."), value, name)
    return cfg


def _replaced(record: Any, path: Sequence[str], value: Any, whole: str) -> Any:
    names = [f.name for f in dataclasses.fields(record)]
    if path[0] not in names:
        raise UserError(
            f"there is no configuration field {whole!r}.",
            fix=f"beside {path[0]!r} there are: {', '.join(names)}",
        )
    current = getattr(record, path[0])
    if len(path) > 1:
        if not dataclasses.is_dataclass(current):
            raise UserError(
                f"the configuration field {whole!r} goes too deep.",
                fix=f"{path[0]!r} is a value itself: leave out what follows it",
            )
        value = _replaced(current, path[1:], value, whole)
    else:
        hint = typing.get_type_hints(type(record))[path[0]]
        if isinstance(value, list):
            value = tuple(value)
        if isinstance(value, int) and not isinstance(value, bool) and not _fits(value, hint):
            value = float(value)
        if not _fits(value, hint):
            raise UserError(f"{whole} = {value!r} does not fit.", fix=f"it takes {_shown(hint)}")
    return dataclasses.replace(record, **{path[0]: value})


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has the type of a configuration field."""
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
    if hint is type(None):
        return value is None
    if dataclasses.is_dataclass(hint):
        return isinstance(value, typing.cast(type, hint))
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, hint)


def _shown(hint: Any) -> str:
    """Return what a field takes, in words."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return ", ".join(repr(a) for a in args)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_shown(a) for a in args)
    if hint is type(None):
        return '"none"'
    return hint.__name__ if isinstance(hint, type) and not args else str(hint)


def grid(base: FitConfig, **axes: Sequence[Any]) -> dict[str, FitConfig]:
    """Return every combination of some fields' values, by a name that says which.

    Args:
        base: all other fields.
        axes: values by field; double underscores stand for dots, as in
            `loss__relative_exposure__weight=[0.01, 0.1]`.

    Raises:
        UserError: see `with_fields`.
    """
    return product(base, {name.replace("__", "."): values for name, values in axes.items()})


def product(base: FitConfig, axes: Mapping[str, Sequence[Any]]) -> dict[str, FitConfig]:
    """Return the same as `grid` for dotted names."""
    out = {}
    for values in itertools.product(*axes.values()):
        chosen = dict(zip(axes, values, strict=True))
        name = ", ".join(f"{field.split('.')[-1]} {value}" for field, value in chosen.items())
        out[name or "base"] = with_fields(base, chosen)
    return out
