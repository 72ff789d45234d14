"""The text of `--help`: an overview of the commands, and prose around the options of each."""

from __future__ import annotations

import inspect
import io
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout, suppress
from itertools import chain
from typing import Any

# Placeholder of the description in tyro's help, replaced by `with_prose`.
ABOUT = "@about@"
EXAMPLE = "p2gs-jax "
INDENT = "    "


def overview(commands: Mapping[str, type], groups: Mapping[str, tuple[str, ...]]) -> str:
    """Return what `p2gs-jax --help` prints.

    Args:
        commands: option classes by name.
        groups: names under their headings; commands in none of them follow at the end.
    """
    grouped = set(chain.from_iterable(groups.values()))
    rest = tuple(name for name in commands if name not in grouped)
    indent = 2 + 2 + max(map(len, commands))
    lines = [
        "usage: p2gs-jax COMMAND [OPTIONS]",
        "",
        *_wrapped("One linear HDR radiance field, and an exposure and a gamma for every view, "
                  "from ordinary photographs."),
    ]  # fmt: skip
    for heading, names in {**groups, "Other": rest}.items():
        present = [name for name in names if name in commands]
        if present:
            lines += ["", heading]
        for name in present:
            head = f"  {name}".ljust(indent)
            lines += _wrapped(first_paragraph(commands[name]), head, " " * indent)
    return "\n".join(
        [
            *lines,
            "",
            "p2gs-jax COMMAND --help   options and examples of one command",
            "p2gs-jax --version        which version this is",
            "",
            "Read on in docs/README.md; docs/quickstart.md begins with your photographs.",
        ]
    )


def first_paragraph(kind: type) -> str:
    """Return the first paragraph of an option class's docstring."""
    return _paragraphs(kind)[0]


def with_prose(text: str, kind: type, brief: bool, name: str) -> str:
    """Return tyro's help with the docstring's prose above the options and its examples below.

    Args:
        text: tyro's help, with `ABOUT` as the description.
        kind: the option class.
        brief: add how to list the options that were left out.
        name: of the command.
    """
    prose = [p for p in _paragraphs(kind) if not p.startswith(EXAMPLE)]
    examples = [p for p in _paragraphs(kind) if p.startswith(EXAMPLE)]
    parts = [text.rstrip().replace(ABOUT, "\n\n".join("\n".join(_wrapped(p)) for p in prose))]
    if brief:
        parts.append(
            f"Every other number of the method, with its unit and source:\n"
            f"{INDENT}p2gs-jax {name} --help-all"
        )
    if examples:
        parts.append("Examples:\n" + textwrap.indent("\n".join(examples), INDENT))
    return "\n\n".join(parts)


def captured(print_help: Callable[[], Any]) -> str:
    """Return what a function prints before it exits, with the colours of the terminal."""
    stream = _Recorder(io.BytesIO(), encoding=sys.stdout.encoding or "utf-8", write_through=True)
    with redirect_stdout(stream), suppress(SystemExit):
        print_help()
    stream.seek(0)
    return stream.read()


class _Recorder(io.TextIOWrapper):
    terminal = sys.__stdout__

    def isatty(self) -> bool:
        return self.terminal is not None and self.terminal.isatty()


def _paragraphs(kind: type) -> list[str]:
    """Return the docstring's paragraphs: prose joined to one line, examples a line each."""
    blocks = [textwrap.dedent(b) for b in inspect.cleandoc(kind.__doc__ or "").split("\n\n")]
    return [b.rstrip() if b.startswith(EXAMPLE) else " ".join(b.split()) for b in blocks]


def _wrapped(text: str, first: str = "", rest: str = "") -> list[str]:
    width = min(80, shutil.get_terminal_size().columns)
    return textwrap.wrap(
        text, width, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )
