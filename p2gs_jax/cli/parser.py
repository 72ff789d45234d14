"""The table of commands, the parser of their options, and completion scripts for shells."""

from __future__ import annotations

import dataclasses
import difflib
import re
import sys
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union

import tyro

from p2gs_jax.cli import help as help_text
from p2gs_jax.cli.doctor import Doctor
from p2gs_jax.cli.evaluate import Eval
from p2gs_jax.cli.experiments import Demo, Sweep, Synth
from p2gs_jax.cli.export import Export
from p2gs_jax.cli.fit import Calibrate, Fit
from p2gs_jax.cli.pages import Compare, Report, View
from p2gs_jax.cli.render import PATHS, Render
from p2gs_jax.cli.scene import Survey
from p2gs_jax.cli.shared import check_option_names
from p2gs_jax.errors import UserError
from p2gs_jax.presets import preset

# tyro completes no paths in the places of options; these lines let the shells do it.
BASH_PATHS = """
_p2gs_jax() {
  _tyro_p2gs_jax "$@"
  [[ -n "${COMPREPLY[*]}" ]] || COMPREPLY=()
}
complete -o default -F _p2gs_jax p2gs-jax
"""
FISH_PATHS = """
complete --command p2gs-jax --force-files --condition \\
  "test (count (commandline -opc)) -gt 1; and not string match -q -- '-*' (commandline -ct)"
"""
# `--path` takes a word or a file; tyro completes files only. The shells look for files where no
# word fits.
PATH_OPTION = re.compile(r"('flags': \['--path'\].*?'type': )'path'(, 'cascade': \w+, 'nargs': 1)")
ZSH_CALL = '_tyro_p2gs_jax "$@"'
Shell = Literal["bash", "zsh", "fish"]


@dataclass(frozen=True)
class Completion:
    """Print what your shell needs to complete commands and options.

    p2gs-jax completion bash > ~/.local/share/bash-completion/completions/p2gs-jax
    p2gs-jax completion zsh > "${fpath[1]}/_p2gs-jax"
    p2gs-jax completion fish > ~/.config/fish/completions/p2gs-jax.fish
    """

    shell: Annotated[Shell, tyro.conf.Positional]
    """bash, zsh or fish."""

    def execute(self) -> int:
        """Print the script."""
        print(completion_script(self.shell), end="")
        return 0


# Every class holds the options of a command and does what the command does: `execute` returns the
# exit code.
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
    "Data with truth, and many fits": ("synth", "sweep"),
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
    if first in HELP or first in (HELP_ALL, ""):
        _print_and_exit(help_text.overview(COMMANDS, GROUPS), 0 if first else 2)
    if first in VERSION:
        from p2gs_jax import __version__

        _print_and_exit(f"p2gs-jax {__version__}", 0)
    if first not in COMMANDS:
        raise _unknown(first)
    return first, _options(first, argv[1:])


def completion_script(shell: Shell) -> str:
    """Return the script that a shell reads to complete commands, options and their values."""
    every = tuple(
        Annotated[
            kind,
            tyro.conf.subcommand(
                name, description=help_text.first_paragraph(kind), default=_defaults(name, [])
            ),
        ]
        for name, kind in COMMANDS.items()
    )
    text = help_text.captured(
        lambda: tyro.cli(
            Union[every],  # type: ignore  # noqa: UP007 (built at run time)
            prog="p2gs-jax",
            args=["--tyro-print-completion", shell],
            registry=help_text.registry(brief=False),
        )
    )
    text = PATH_OPTION.sub(rf"\1'choice'\2, 'choices': {list(PATHS)}", text)
    if shell == "bash":
        return text + BASH_PATHS
    if shell == "zsh":
        return text.rstrip().removesuffix(ZSH_CALL) + f"{ZSH_CALL} || _files\n"
    return text + FISH_PATHS


def _options(name: str, argv: list[str]) -> Any:
    kind = COMMANDS[name]
    names = (*(f.name for f in dataclasses.fields(kind)), *getattr(kind, "SHORT_NAMES", ()))
    check_option_names(name, argv, {f"--{n.replace('_', '-')}" for n in names})
    asked = any(a in HELP for a in argv)
    brief = asked and HELP_ALL not in argv

    def answer() -> Any:
        return tyro.cli(
            kind,
            prog=f"p2gs-jax {name}",
            description=help_text.ABOUT,
            args=["--help" if a == HELP_ALL else a for a in argv],
            default=_defaults(name, argv),
            registry=help_text.registry(brief),
        )

    if not asked and HELP_ALL not in argv:
        return answer()
    more = name if brief and name in WITH_CONFIGURATION else ""
    _print_and_exit(help_text.with_prose(help_text.captured(answer), kind, more), 0)


def _defaults(name: str, argv: list[str]) -> Any:
    """Return the defaults of a command's options; those of the configuration are the preset's."""
    if name not in WITH_PRESET:
        return tyro.MISSING_NONPROP
    name_of_preset: Any = "robust"
    for i, arg in enumerate(argv):
        if arg == "--preset" and i + 1 < len(argv):
            name_of_preset = argv[i + 1]
        elif arg.startswith("--preset="):
            name_of_preset = arg.split("=", 1)[1]
    return COMMANDS[name](tyro.MISSING, tyro.MISSING, preset(name_of_preset))


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
