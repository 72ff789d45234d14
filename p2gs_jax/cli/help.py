"""How options are read and shown: rules for tyro, the overview of commands, prose around options.

The text of an option is the string below its field, or the `help` of its type. What tyro prints
beside it (names of types, `(default: None)`) is replaced here.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import shutil
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro import constructors

from p2gs_jax.cli.shared import parse_duration
from p2gs_jax.config import DataConfig, FitConfig
from p2gs_jax.options import SHORT

PLACEHOLDERS = {int: "N", float: "X", str: "TEXT", Path: "PATH"}
EXAMPLE = "p2gs-jax "
INDENT = "    "
DURATION = constructors.PrimitiveConstructorSpec(
    nargs=1,
    metavar="TIME",
    instance_from_str=lambda words: None if words[0] == "None" else parse_duration(words[0]),
    is_instance=lambda value: value is None or isinstance(value, float),
    str_from_instance=lambda value: [str(value)],
)


def registry(brief: bool) -> constructors.ConstructorRegistry:
    """Return the rules by which tyro reads our option classes.

    `brief` help shows only those fields of the configuration that have short names.
    """
    rules = constructors.ConstructorRegistry()
    # Short names by field, and the fields that are options, of the command that is being read.
    short: dict[str, str] = {}
    only: list[str] = []

    @rules.struct_rule
    def options(info: constructors.StructTypeInfo) -> constructors.StructConstructorSpec | None:
        kind, default = info.type, info.default
        if not dataclasses.is_dataclass(kind) or not kind.__module__.startswith("p2gs_jax."):
            return None
        if hasattr(kind, "SHORT_NAMES"):  # a command: tyro reads its configuration next
            short.clear()
            short.update({SHORT[name][0]: name for name in kind.SHORT_NAMES})
            only[:] = getattr(kind, "FIELDS", ())
            if brief:
                return constructors.StructConstructorSpec(kind, tuple(_brief(kind, default)))
        group = next((f"{n}." for n, hint in _hints(FitConfig).items() if hint is kind), "")
        if not (group or kind is FitConfig):
            return constructors.StructConstructorSpec(kind, tuple(_fields(kind, default, short)))
        # Fields that are not options stay as the preset has them; the command has `preset`.
        default = default if isinstance(default, kind) else kind()
        fields = [f for f in _fields(kind, default, short) if f.name != "preset"]
        if only and group[:-1] not in only:
            inside = [path.removeprefix(group) for path in only if path.startswith(group)]
            fields = [f for f in fields if f.name in {path.partition(".")[0] for path in inside}]

        def make(**values: Any) -> Any:
            return dataclasses.replace(default, **values)

        make.__doc__ = kind.__doc__
        return constructors.StructConstructorSpec(make, tuple(fields))

    rules.primitive_rule(_number_rule)
    return rules


def _number_rule(
    info: constructors.PrimitiveTypeInfo,
) -> constructors.PrimitiveConstructorSpec | None:
    """Return the parser of a number, a few words, or None, with plain error messages."""
    kinds = set(get_args(info.type)) if _is_union(info.type) else {info.type}
    words = [word for k in kinds if get_origin(k) is Literal for word in get_args(k)]
    numbers = {k for k in kinds if get_origin(k) is not Literal} - {NoneType}
    if numbers not in ({int}, {float}) or not all(isinstance(word, str) for word in words):
        return None
    (kind,) = numbers
    known: dict[str, Any] = {word: word for word in sorted(words)}
    values = known | ({"None": None} if NoneType in kinds else {})

    def read(argument: list[str]) -> Any:
        if argument[0] in values:
            return values[argument[0]]
        try:
            return kind(argument[0])
        except ValueError:
            noun = "whole number" if kind is int else "number"
            other = f", and not {' or '.join(known)}" if known else ""
            raise ValueError(f"{argument[0]!r} is not a {noun}{other}") from None

    def fits(value: Any) -> bool:
        return value in values.values() or type(value) is kind

    return constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="|".join([*known, PLACEHOLDERS[kind]]),
        instance_from_str=read,
        is_instance=fits,
        str_from_instance=lambda value: [str(value)],
    )


def _brief(kind: type, default: Any) -> Iterator[constructors.StructFieldSpec]:
    """Yield a command's options without groups; short names replace the whole configuration."""
    for spec in _fields(kind, default, {}):
        if not isinstance(spec.default, FitConfig | DataConfig):
            if not dataclasses.is_dataclass(spec.default):
                yield spec
            continue
        for short in kind.SHORT_NAMES:  # type: ignore
            group, field = SHORT[short][0].split(".")
            parent = getattr(spec.default, group, spec.default)
            yield _field(type(parent), field, parent, short)


def _fields(
    kind: type, default: Any, short: Mapping[str, str]
) -> Iterator[constructors.StructFieldSpec]:
    group = next((n for n, hint in _hints(FitConfig).items() if hint is kind), None)
    for name, hint in _hints(kind).items():
        if get_origin(hint) is tuple and any(map(dataclasses.is_dataclass, get_args(hint))):
            continue  # These are records that a scene decides, and not options.
        yield _field(kind, name, default, short.get(f"{group}.{name}"), brief=False)


def _field(
    kind: type, name: str, parent: Any, short: str | None, *, brief: bool = True
) -> constructors.StructFieldSpec:
    """Return tyro's rule for the option of a field; `parent` is the default of its class.

    In `brief` help a short name replaces the long one.
    """
    hint, default = _hints(kind)[name], _default(kind, name, parent)
    extras = (*_settings(kind, name, hint, default, brief and short is not None), *_extras(hint))
    if short is not None:
        placeholder, dashed = SHORT[short][1], short.replace("_", "-")
        shown: dict[str, Any] = {} if placeholder is None else {"metavar": placeholder}
        if brief:
            extras = (*extras, tyro.conf.arg(**shown, name=dashed, prefix_name=False))
        else:
            extras = (*extras, tyro.conf.arg(**shown, aliases=(f"--{dashed}",)))
    if name == "budget" or name.endswith("_s"):
        extras = (*extras, DURATION, tyro.conf.arg(metavar="TIME"))
    return constructors.StructFieldSpec(
        name=name,
        type=Annotated[(_plain(hint), *extras)],  # type: ignore
        default=default,
        helptext=lambda: _field_docs(kind).get(name),
    )


def _default(kind: type, name: str, parent: Any) -> Any:
    if parent is constructors.MISSING:
        return constructors.MISSING
    if parent is not constructors.MISSING_NONPROP and hasattr(parent, name):
        return getattr(parent, name)
    field = next(f for f in dataclasses.fields(kind) if f.name == name)
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return constructors.MISSING_NONPROP if field.default is dataclasses.MISSING else field.default


def _settings(kind: type, name: str, hint: Any, default: Any, brief: bool) -> tuple[Any, ...]:
    """Return tyro's settings of an option, which annotations of its field may override.

    In the configuration None is a value like others. In all other options of a command it means
    that the option is absent; there a switch that is off can only be turned on.
    """
    plain, none_counts = _plain(hint), kind.__module__ == FitConfig.__module__ and not brief
    if plain is bool and not none_counts and not default:
        return tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")
    positional = tyro.conf.Positional in _extras(hint)
    shown = name.upper() if positional else _placeholder(plain, none_counts)
    hint_of = functools.partial(_default_shown, none_counts=none_counts)
    return (tyro.conf.arg(metavar=shown, help_behavior_hint=hint_of),)


def _placeholder(plain: Any, none_counts: bool) -> str | None:
    """Return the placeholder of a value of a type, or None for tyro's placeholder."""
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


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


@functools.cache
def _field_docs(kind: type) -> dict[str, str]:
    """Return the strings below fields as one paragraph each."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body  # type: ignore
    return {
        field.target.id: " ".join(str(text.value.value).split())
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }


def overview(groups: Mapping[str, Mapping[str, type]]) -> str:
    """Return the text of `p2gs-jax --help`; `groups` are option classes by command and heading."""
    indent = 2 + 2 + max(len(name) for commands in groups.values() for name in commands)
    about = (
        "p2gs-jax fits one linear HDR radiance field, and an exposure and a tone curve for each "
        "photograph."
    )
    lines = ["usage: p2gs-jax COMMAND [OPTIONS]", "", *_wrapped(about)]
    for heading, commands in groups.items():
        lines += ["", heading]
        for name, kind in commands.items():
            head = f"  {name}".ljust(indent)
            lines += _wrapped(_paragraphs(kind)[0][0], head, " " * indent)
    lines += [
        "",
        "p2gs-jax COMMAND --help   options and examples of one command",
        "p2gs-jax --version        version of p2gs-jax",
        "",
        "Documentation: docs/README.md; docs/quickstart.md begins with your photographs.",
    ]
    return "\n".join(lines)


def prose(kind: type) -> str:
    """Return the text above the options in a command's help: the docstring's prose."""
    return "\n\n".join("\n".join(_wrapped(p)) for p in _paragraphs(kind)[0])


def examples(kind: type, name: str) -> str:
    """Return the text below the options: the docstring's examples.

    With the `name` of a command whose help is brief, the text also names the full help.
    """
    below = [f"{INDENT}{line}" for line in _paragraphs(kind)[1]]
    if below:
        below.insert(0, "Examples:")
    if name:
        more = "All options, with units and sources:"
        below = [more, f"{INDENT}p2gs-jax {name} --help-all", "", *below]
    return "\n".join(below)


def _paragraphs(kind: type) -> tuple[list[str], list[str]]:
    """Return the paragraphs of an option class's docstring, a line each, and its examples."""
    blocks = [textwrap.dedent(b) for b in inspect.cleandoc(kind.__doc__ or "").split("\n\n")]
    shown = [line for b in blocks if b.startswith(EXAMPLE) for line in b.splitlines()]
    return [" ".join(b.split()) for b in blocks if not b.startswith(EXAMPLE)], shown


def _wrapped(text: str, first: str = "", rest: str = "") -> list[str]:
    width = min(80, shutil.get_terminal_size().columns)
    return textwrap.wrap(
        text, width, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )
