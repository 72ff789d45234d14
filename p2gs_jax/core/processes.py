"""Search path of imports in this process and in the processes that it starts.

The working folder may hold a scene: a `cv2.py` beside the photographs would run if Python searched
there. `python -m` and an empty part of PYTHONPATH search the working folder.
"""

from __future__ import annotations

import os
import sys

# The folder of the package: an uninstalled checkout may be the working folder.
_PACKAGE = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))


def leave_out_working_folder() -> None:
    """Remove the working folder from the search path of imports."""
    sys.path[:] = _search_path()


def environment() -> dict[str, str]:
    """Return the environment of a Python process that this one starts.

    It has the search path of this process, without the working folder.
    """
    path = os.pathsep.join(_search_path())
    return {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}


def _search_path() -> list[str]:
    try:
        here = os.path.realpath(os.getcwd())
    except OSError:  # the working folder was removed
        return [folder for folder in sys.path if folder]
    kept = [folder for folder in sys.path if folder and os.path.realpath(folder) != here]
    return [_PACKAGE, *kept] if here == os.path.realpath(_PACKAGE) else kept
