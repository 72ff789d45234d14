"""The command line: `p2gs-jax SUBCOMMAND`; COMMANDS lists them.

Every configuration field is an option. Bad input ends with one message and exit code 2.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Annotated, Any, Union

# Quiet the native libraries before they load; our own messages say what matters.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("GLOG_minloglevel", "2")

import tyro

from p2gs_jax.errors import UserError
from p2gs_jax.options.experiments import Bench, Demo, Sweep, Synth
from p2gs_jax.options.export import Export
from p2gs_jax.options.fit import Calibrate, Fit, named_preset
from p2gs_jax.options.results import Eval, Render

# A name is both the subcommand and the module of `p2gs_jax.commands` that runs it.
COMMANDS: dict[str, type] = {
    "fit": Fit,
    "calibrate": Calibrate,
    "render": Render,
    "eval": Eval,
    "export": Export,
    "demo": Demo,
    "synth": Synth,
    "sweep": Sweep,
    "bench": Bench,
}
WITH_PRESET = ("fit", "calibrate")


def _preset_name(argv: list[str]) -> str:
    """Return what `--preset` names: its values become the defaults of all options."""
    name = "robust"
    for i, arg in enumerate(argv):
        if arg == "--preset" and i + 1 < len(argv):
            name = argv[i + 1]
        elif arg.startswith("--preset="):
            name = arg.split("=", 1)[1]
    return name


def _subcommands(argv: list[str]) -> Any:
    """Return the union of all option classes that tyro parses."""
    cfg = named_preset(_preset_name(argv))
    members = []
    for name, kind in COMMANDS.items():
        defaults = {"default": kind(tyro.MISSING, tyro.MISSING, cfg)} if name in WITH_PRESET else {}
        members.append(Annotated[kind, tyro.conf.subcommand(name, **defaults)])
    return Union[tuple(members)]  # noqa: UP007 (built at run time)


def _run(argv: list[str]) -> int:
    options = tyro.cli(
        _subcommands(argv),
        prog="p2gs-jax",
        description="Photometrically consistent Gaussian splatting in JAX.",
        args=argv,
    )
    name = next(name for name, kind in COMMANDS.items() if isinstance(options, kind))
    # Imported here so that --help answers at once.
    from p2gs_jax.compile_cache import use_compile_cache

    use_compile_cache()
    return import_module(f"p2gs_jax.commands.{name}").run(options)


def main(argv: list[str] | None = None) -> None:
    """Run the command line and exit.

    Codes: 0 done, 1 worse than a baseline, 2 bad input, 130 interrupted.
    """
    try:
        code = _run(sys.argv[1:] if argv is None else argv)
    except UserError as error:
        print(f"p2gs-jax: error: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("p2gs-jax: interrupted; --resume continues from the last checkpoint", file=sys.stderr)
        code = 130
    except BrokenPipeError:  # what reads our output has seen enough, as head does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code)
