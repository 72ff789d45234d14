"""Rules for tyro: one paragraph of help per option, and short placeholders.

The text of an option is the string below its field. What tyro prints beside it (names of types,
`(default: None)`) is replaced here.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    MISSING,
    MISSING_NONPROP,
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from p2gs_jax.config import DataConfig, FitConfig

PLACEHOLDERS = {int: "N", float: "X", str: "TEXT", Path: "PATH"}


def registry(brief: bool) -> ConstructorRegistry:
    """Return the rule by which tyro reads our option classes.

    Args:
        brief: leave out the configuration's groups of options.
    """
    rules = ConstructorRegistry()

    @rules.struct_rule
    def options(info: StructTypeInfo) -> StructConstructorSpec | None:
        kind = info.type
        if not dataclasses.is_dataclass(kind) or not kind.__module__.startswith("p2gs_jax."):
            return None
        if kind is FitConfig:
            return _configuration(info, brief)
        if kind is DataConfig and brief:
            return StructConstructorSpec(DataConfig, ())
        return StructConstructorSpec(kind, tuple(_fields(kind, info.default)))

    rules.primitive_rule(_number_rule)
    return rules


def _number_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Return the parser of a number, a few words, or None, with plain error messages."""
    kinds = set(get_args(info.type)) if _is_union(info.type) else {info.type}
    optional = NoneType in kinds
    kinds -= {NoneType}
    known = {word for k in kinds if get_origin(k) is Literal for word in get_args(k)}
    kinds = {k for k in kinds if get_origin(k) is not Literal}
    if kinds not in ({int}, {float}) or not all(isinstance(word, str) for word in known):
        return None
    (kind,) = kinds

    def read(words: list[str]) -> int | float | str | None:
        if optional and words[0] == "None":
            return None
        if words[0] in known:
            return words[0]
        try:
            return kind(words[0])
        except ValueError:
            what = "whole number" if kind is int else "number"
            other = f", and not {' or '.join(sorted(known))}" if known else ""
            raise ValueError(f"{words[0]!r} is no {what}{other}") from None

    def fits(value: Any) -> bool:
        if isinstance(value, str):
            return value in known
        return value is None if not isinstance(value, kind) else not isinstance(value, bool)

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="|".join([*sorted(known), PLACEHOLDERS[kind]]),
        instance_from_str=read,
        is_instance=fits,
        str_from_instance=lambda value: [str(value)],
    )


def _configuration(info: StructTypeInfo, brief: bool) -> StructConstructorSpec:
    """Return the configuration's groups without `preset`, which is an option of the command."""
    default = info.default if isinstance(info.default, FitConfig) else FitConfig()
    if brief:
        return StructConstructorSpec(lambda: default, ())
    return StructConstructorSpec(
        functools.partial(FitConfig, preset=default.preset),
        tuple(f for f in _fields(FitConfig, default) if f.name != "preset"),
    )


def _fields(kind: type, default: Any) -> Iterator[StructFieldSpec]:
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        if get_origin(hint) is tuple and any(map(dataclasses.is_dataclass, get_args(hint))):
            continue  # Records that a scene decides: no option.
        value = _default(field, default)
        yield StructFieldSpec(
            name=field.name,
            # A field's own settings come last and take precedence.
            type=Annotated[
                (_plain(hint), *_option_config(kind, field.name, hint, value), *_extras(hint))
            ],  # type: ignore
            default=value,
            helptext=functools.partial(_text, kind, field.name),
        )


def _default(field: dataclasses.Field, parent: Any) -> Any:
    if parent is MISSING:
        return MISSING
    if parent is not MISSING_NONPROP and hasattr(parent, field.name):
        return getattr(parent, field.name)
    if field.default is not dataclasses.MISSING:
        return field.default
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return MISSING_NONPROP


def _option_config(kind: type, name: str, hint: Any, default: Any) -> tuple[Any, ...]:
    """Return tyro's settings of an option, which those of its field may override.

    In the configuration None is a value like others; in a command's own options it means "not
    given", and there a switch that is off can only be turned on.
    """
    plain, none_counts = _plain(hint), kind.__module__ == FitConfig.__module__
    if plain is bool and not none_counts and not default:
        return tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")
    positional = tyro.conf.Positional in _extras(hint)
    shown = name.upper() if positional else _placeholder(plain, none_counts)
    hint_of = functools.partial(_default_shown, none_counts=none_counts)
    return (tyro.conf.arg(metavar=shown, help_behavior_hint=hint_of),)


def _placeholder(plain: Any, none_counts: bool) -> str | None:
    """Return the placeholder of a value of a type, or None for tyro's own."""
    origin, args = get_origin(plain), get_args(plain)
    if _is_union(plain):
        parts = [_placeholder(a, none_counts) or "" for a in args if a is not NoneType]
        choices = ",".join(p.strip("{}") for p in parts if p.startswith("{"))
        others = [p for p in parts if not p.startswith("{")]
        if NoneType in args and none_counts:
            choices, others = (f"{choices},None", others) if choices else ("", [*others, "None"])
        return "|".join([*([f"{{{choices}}}"] if choices else []), *others])
    if origin is Literal:
        return "{" + ",".join(map(str, args)) + "}"
    if origin is tuple:
        shown = [_placeholder(a, none_counts) or "" for a in args if a is not Ellipsis]
        return f"[{shown[0]} ...]" if Ellipsis in args else " ".join(shown)
    return PLACEHOLDERS.get(plain)


def _default_shown(default: str, *, none_counts: bool) -> str:
    """Return the default that follows an option's text, or nothing."""
    if not default or (default == "None" and not none_counts):
        return ""
    with suppress(ValueError):
        default = f"{float(default):.4g}" if "." in default else default
    return f"(default: {default})"


def _is_union(hint: Any) -> bool:
    return get_origin(hint) in (Union, UnionType)


def _plain(hint: Any) -> Any:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _extras(hint: Any) -> tuple[Any, ...]:
    return get_args(hint)[1:] if get_origin(hint) is Annotated else ()


def _text(kind: type, name: str) -> str | None:
    """Return the string below a field as one paragraph."""
    found = (_field_docs(k).get(name) for k in kind.__mro__ if dataclasses.is_dataclass(k))
    text = next((t for t in found if t is not None), None)
    return None if text is None else " ".join(text.split())


@functools.cache
def _field_docs(kind: type) -> dict[str, str]:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    except (OSError, SyntaxError):
        return {}
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    return {
        field.target.id: str(text.value.value)
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }
