"""The table of commands, and the parser of their options."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import io
import itertools
import sys
from typing import Any

import tyro

from p2gs_jax.cli import help as help_text
from p2gs_jax.cli.doctor import Doctor
from p2gs_jax.cli.evaluate import Eval
from p2gs_jax.cli.experiments import Demo, Sweep, Synth
from p2gs_jax.cli.export import Export
from p2gs_jax.cli.fit import Calibrate, Fit, Inspect
from p2gs_jax.cli.pages import Compare, Report, View
from p2gs_jax.cli.render import Render
from p2gs_jax.cli.shared import COMMANDS_OF_OTHERS, check_option_names
from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError
from p2gs_jax.presets import preset

# A class holds the options of a command, and its `execute` runs the command and returns the exit
# code. `p2gs-jax --help` lists commands in this order, in which a new user needs them.
GROUPS: dict[str, dict[str, type]] = {
    "First": {"doctor": Doctor, "demo": Demo},
    "From photographs": {"inspect": Inspect, "fit": Fit, "calibrate": Calibrate},
    "With a finished run": {
        **{"view": View, "report": Report, "render": Render},
        **{"export": Export, "eval": Eval, "compare": Compare},
    },
    "Data with known exposures, and many fits": {"synth": Synth, "sweep": Sweep},
}
COMMANDS = {name: kind for group in GROUPS.values() for name, kind in group.items()}
WITH_PRESET = ("fit", "calibrate")
# Commands whose `--help` is short; their `--help-all` lists the whole configuration.
WITH_CONFIGURATION = (*WITH_PRESET, "inspect")
# Options whose value may be left out, and their values; the first is then used.
BARE = {"--develop": ("8bit", "16bit", "exr")}
HELP, HELP_ALL, VERSION = ("-h", "--help"), "--help-all", ("-V", "--version")


def parse(argv: list[str]) -> tuple[str, Any]:
    """Return the command's name and its options.

    UserError: there is no such command or preset, an argument is empty, or the option is another
    program's. SystemExit: 0 after requested help or version, 2 without a command or with invalid
    options.
    """
    first = argv[0] if argv else ""
    if first in HELP or first in (HELP_ALL, ""):
        _print_and_exit(help_text.overview(GROUPS), 0 if first else 2)
    if first in VERSION:
        from p2gs_jax import __version__

        _print_and_exit(f"p2gs-jax {__version__}", 0)
    if first not in COMMANDS:
        raise _unknown(first)
    return first, _options(first, argv[1:])


def _options(name: str, argv: list[str]) -> Any:
    kind = COMMANDS[name]
    names = (*(f.name for f in dataclasses.fields(kind)), *getattr(kind, "SHORT_NAMES", ()))
    check_option_names(name, argv, {f"--{n.replace('_', '-')}" for n in names})
    for before, word in itertools.pairwise((name, *argv)):
        # Python takes an empty path, often an unset variable of a shell, for the current folder.
        if not word or (word.startswith("--") and word.endswith("=")):
            why = f"the argument after {word or before} is empty."
            raise UserError(why, fix="name a file or folder, or write . for the current folder")
    whole = HELP_ALL in argv
    brief = not whole and any(a in HELP for a in argv)
    if brief or whole:
        print(help_text.prose(kind) + "\n")

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(
                kind,
                prog=f"p2gs-jax {name}",
                description="",
                args=_with_values(["--help" if a == HELP_ALL else a for a in argv]),
                default=_defaults(name, argv),
                registry=help_text.registry(brief),
            )
    except SystemExit as end:
        # tyro repeats words unchanged; file names among them may have control characters.
        print(printable(complaint.getvalue()), end="", file=sys.stderr)
        if end.code == 0:
            more = name if brief and name in WITH_CONFIGURATION else ""
            print("\n" + help_text.examples(kind, more))
        raise


def _with_values(argv: list[str]) -> list[str]:
    """Return the words with the first value of `BARE` after an option that has no value."""
    out = []
    for word, following in itertools.zip_longest(argv, argv[1:]):
        bare = word in BARE and following not in BARE[word]
        out += [word, BARE[word][0]] if bare else [word]
    return out


def _defaults(name: str, argv: list[str]) -> Any:
    """Return the defaults of a command's options; the configuration is a preset."""
    if name not in WITH_PRESET:
        return tyro.MISSING_NONPROP
    name_of_preset: Any = "robust"
    for i, arg in enumerate(argv):
        if arg == "--preset" and i + 1 < len(argv):
            name_of_preset = argv[i + 1]
        elif arg.startswith("--preset="):
            name_of_preset = arg.split("=", 1)[1]
    required = {} if name == "fit" else {"out": tyro.MISSING}
    return COMMANDS[name](scene=tyro.MISSING, config=preset(name_of_preset), **required)


def _unknown(word: str) -> UserError:
    if word.startswith("-"):
        return UserError(f"{word} comes before any command.", fix="write p2gs-jax COMMAND OPTIONS")
    ours = COMMANDS_OF_OTHERS.get(word.removeprefix("ns-").removesuffix(".py"))
    if ours is not None:
        fix = f"write p2gs-jax {ours}"
        return UserError(f"there is no command {word!r}.", fix=fix)
    near = difflib.get_close_matches(word, COMMANDS, n=2, cutoff=0.5)
    guess = f"did you mean {' or '.join(near)}? " if near else ""
    fix = f"{guess}`p2gs-jax --help` lists all commands"
    return UserError(f"there is no command {word!r}.", fix=fix)


def _print_and_exit(text: str, code: int) -> None:
    print(text, file=sys.stderr if code else sys.stdout)
    sys.exit(code)
