"""The table of commands, and the parser of their options."""

from __future__ import annotations

import dataclasses
import difflib
import sys
from typing import Annotated, Any, Union

import tyro

from p2gs_jax.cli import help_text
from p2gs_jax.cli.options.experiments import Demo, Sweep, Synth
from p2gs_jax.cli.options.export import Export
from p2gs_jax.cli.options.fit import Calibrate, Fit, named_preset
from p2gs_jax.cli.options.pages import Compare, Report
from p2gs_jax.cli.options.render import Render
from p2gs_jax.cli.options.results import Eval
from p2gs_jax.cli.options.setup import Completion, Doctor
from p2gs_jax.cli.options.survey import Survey
from p2gs_jax.cli.options.view import View
from p2gs_jax.cli.synonyms import check_option_names
from p2gs_jax.cli.tyro_rules import registry
from p2gs_jax.errors import UserError

# A name is both the subcommand and the module of `p2gs_jax.cli.commands` that runs it.
COMMANDS: dict[str, type] = {
    "fit": Fit,
    "calibrate": Calibrate,
    "scene": Survey,
    "render": Render,
    "eval": Eval,
    "export": Export,
    "view": View,
    "report": Report,
    "compare": Compare,
    "demo": Demo,
    "synth": Synth,
    "sweep": Sweep,
    "doctor": Doctor,
    "completion": Completion,
}
# The order of `p2gs-jax --help`: as a new user needs them.
GROUPS: dict[str, tuple[str, ...]] = {
    "First": ("doctor", "demo"),
    "From photographs": ("scene", "fit", "calibrate"),
    "With a finished run": ("view", "report", "render", "export", "eval", "compare"),
    "Data with truth, and sweeps": ("synth", "sweep"),
    "Your shell": ("completion",),
}
WITH_PRESET = ("fit", "calibrate")
# Their `--help` is short, and `--help-all` is not.
WITH_CONFIGURATION = (*WITH_PRESET, "scene")
HELP, HELP_ALL, VERSION = ("-h", "--help"), "--help-all", ("-V", "--version")


def parse(argv: list[str]) -> tuple[str, Any]:
    """Return the command's name and its options.

    Raises:
        UserError: there is no such command or preset.
        SystemExit: 0 after help was asked for and printed, 2 after a complaint about options.
    """
    first = argv[0] if argv else ""
    if first in HELP or first == HELP_ALL:
        _print_and_exit(help_text.overview(COMMANDS, GROUPS), 0)
    if first in VERSION:
        from p2gs_jax import __version__

        _print_and_exit(f"p2gs-jax {__version__}", 0)
    if not first:
        _print_and_exit(help_text.overview(COMMANDS, GROUPS), 2)
    if first not in COMMANDS:
        raise _unknown(first)
    return first, _options(first, argv[1:])


def every_command() -> Any:
    """Return the union of all option classes, with which tyro can complete any command."""
    return Union[  # noqa: UP007 (built at run time)
        tuple(
            Annotated[
                kind,
                tyro.conf.subcommand(
                    name, description=help_text.first_paragraph(kind), default=_defaults(name, [])
                ),
            ]
            for name, kind in COMMANDS.items()
        )
    ]


def _options(name: str, argv: list[str]) -> Any:
    check_option_names(name, argv, _own_options(name))
    wants_all = HELP_ALL in argv
    argv = ["--help" if a == HELP_ALL else a for a in argv]
    brief = not wants_all and any(a in HELP for a in argv)

    def answer() -> Any:
        return tyro.cli(
            COMMANDS[name],
            prog=f"p2gs-jax {name}",
            description=help_text.ABOUT,
            args=argv,
            default=_defaults(name, argv),
            registry=registry(brief),
        )

    if not any(a in HELP for a in argv):
        return answer()
    text = help_text.captured(answer)
    _print_and_exit(
        help_text.with_prose(text, COMMANDS[name], brief and name in WITH_CONFIGURATION, name), 0
    )


def _own_options(name: str) -> set[str]:
    """Return the names of a command's own options, such as `--max-width`."""
    fields = dataclasses.fields(COMMANDS[name])
    return {f"--{field.name.replace('_', '-')}" for field in fields}


def _defaults(name: str, argv: list[str]) -> Any:
    """Return the defaults of a command's options; those of the configuration are the preset's."""
    if name not in WITH_PRESET:
        return tyro.MISSING_NONPROP
    cfg = named_preset(_preset_name(argv))
    return COMMANDS[name](tyro.MISSING, tyro.MISSING, cfg)


def _preset_name(argv: list[str]) -> str:
    name = "robust"
    for i, arg in enumerate(argv):
        if arg == "--preset" and i + 1 < len(argv):
            name = argv[i + 1]
        elif arg.startswith("--preset="):
            name = arg.split("=", 1)[1]
    return name


def _unknown(word: str) -> UserError:
    if word.startswith("-"):
        return UserError(f"{word} comes before any command.", fix="write p2gs-jax COMMAND OPTIONS")
    near = difflib.get_close_matches(word, COMMANDS, n=2, cutoff=0.5)
    guess = f"did you mean {' or '.join(near)}? " if near else ""
    return UserError(
        f"there is no command {word!r}.", fix=f"{guess}`p2gs-jax --help` lists all commands"
    )


def _print_and_exit(text: str, code: int) -> None:
    print(text, file=sys.stderr if code else sys.stdout)
    sys.exit(code)
