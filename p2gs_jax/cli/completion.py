"""Completion scripts for shells, made by tyro from the parser of all commands."""

from __future__ import annotations

import re

import tyro

from p2gs_jax.cli import help_text
from p2gs_jax.cli.options.render import PATHS
from p2gs_jax.cli.options.setup import Shell
from p2gs_jax.cli.parser import every_command
from p2gs_jax.cli.tyro_rules import registry

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


def script(shell: Shell) -> str:
    """Return the script that a shell reads to complete commands, options and their values."""
    text = help_text.captured(
        lambda: tyro.cli(
            every_command(),
            prog="p2gs-jax",
            args=["--tyro-print-completion", shell],
            registry=registry(brief=False),
        )
    )
    text = PATH_OPTION.sub(rf"\1'choice'\2, 'choices': {list(PATHS)}", text)
    if shell == "bash":
        return text + BASH_PATHS
    if shell == "zsh":
        return text.rstrip().removesuffix(ZSH_CALL) + f"{ZSH_CALL} || _files\n"
    return text + FISH_PATHS
