"""This process and those that it starts: where they import from.

A working folder holds somebody's scene: a `cv2.py` beside the photographs would run where Python
looks for modules there. `python -m` does, and so does an empty part of PYTHONPATH.
"""

from __future__ import annotations

import os
import sys

# The folder that holds the package: an uninstalled checkout may be the working folder.
_OWN = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))


def leave_out_working_folder() -> None:
    """Import nothing from the working folder any more."""
    sys.path[:] = _search_path()


def environment() -> dict[str, str]:
    """Return the environment of a Python process of ours, and of those that it starts.

    They import from where this process does, and not from the working folder.
    """
    path = os.pathsep.join(_search_path())
    return {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}


def _search_path() -> list[str]:
    try:
        here = os.path.realpath(os.getcwd())
    except OSError:  # it was removed
        return [place for place in sys.path if place]
    kept = [place for place in sys.path if place and os.path.realpath(place) != here]
    return [_OWN, *kept] if here == os.path.realpath(_OWN) else kept
