"""The command line: `p2gs-jax COMMAND ...`; `p2gs-jax --help` lists the commands.

Every configuration field is an option. Bad input ends with one message and exit code 2.
"""

from __future__ import annotations

import os
import sys

from p2gs_jax.core import interrupts
from p2gs_jax.core.memory import ran_out
from p2gs_jax.core.processes import leave_out_working_folder
from p2gs_jax.errors import UserError

# Silence the native libraries before they load.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("GLOG_minloglevel", "3")
os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # warnings print unescaped file names
# Pillow's limit, pixels: OpenCV too refuses larger pictures before it decodes them.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2 * 89_478_485))


def _run(argv: list[str]) -> int:
    # Everything is imported where it is needed, so that --help answers at once.
    from p2gs_jax.cli.parser import parse

    name, options = parse(argv)
    if name != "doctor":  # which must work without JAX
        from p2gs_jax.core.runtime import tune_process, use_compile_cache

        use_compile_cache()
        tune_process()
    return options.execute()


def main(argv: list[str] | None = None) -> None:
    """Run the command line and exit.

    Exit codes: 0 done; 1 a run of a sweep failed, or the installation or a report is incomplete; 2
    an error with a message; 128 + the signal's number (130 Ctrl-C, 143 SIGTERM).
    """
    if argv is None:
        argv = sys.argv[1:]
        leave_out_working_folder()
    command = argv[0] if argv else ""
    try:
        with interrupts.raised():
            code = _run(argv)
    except UserError as error:
        code = _complain(error)
    except ImportError as error:
        code = _missing(error, argv)
    except (OSError, MemoryError, RuntimeError) as error:
        if ran_out(error):
            fix = "end other programs, or choose smaller pictures or fewer Gaussians"
            code = _complain(UserError(f"memory ran out ({error}).", fix=fix))
        elif isinstance(error, OSError):
            code = _from_the_system(error)
        else:
            raise
    except KeyboardInterrupt as error:
        notes = getattr(error, "__notes__", [_CONTINUED.get(command, "")])
        print(f"p2gs-jax: interrupted{''.join(notes)}", file=sys.stderr)
        code = interrupts.exit_code(error)
    sys.exit(code)


_CONTINUED = {
    "sweep": "; the same command continues it",
    "demo": "; the same command begins it again",
}


def _complain(error: UserError) -> int:
    from p2gs_jax.core.text import printable

    print(printable(f"p2gs-jax: error: {error}"), file=sys.stderr)
    return 2


def _missing(error: ImportError, argv: list[str]) -> int:
    """Report which library is broken; `doctor` runs even if the parser needs that library."""
    if (error.name or "").split(".")[0] == "p2gs_jax":
        raise error
    if argv[:1] == ["doctor"]:
        from p2gs_jax.cli.doctor import Doctor

        return Doctor().execute()
    fix = "`p2gs-jax doctor` lists missing libraries"
    return _complain(UserError(f"a library cannot be imported: {error}.", fix=fix))


def _from_the_system(error: OSError) -> int:
    """Report an error of the operating system; after a broken pipe, end silently."""
    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    where = f"{error.filename}: " if error.filename else ""
    reason = error.strerror or str(error)
    fix = "check that the path exists and may be read or written, and that the disk has room"
    return _complain(UserError(f"{where}{reason}.", fix=fix))
