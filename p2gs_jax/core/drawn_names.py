"""Names of others, such as those of cameras and folders, in pictures that matplotlib draws."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def names_as_they_are() -> Iterator[None]:
    """Let matplotlib draw names as they are: a `with` block, or a decorator.

    What stands between dollars is no formula, and letters that the font lacks are boxes in the
    picture, no matter for the terminal. Control characters are the caller's (`printable`).
    """
    # Imported here: it takes as long to load as a small scene to read.
    import matplotlib

    with matplotlib.rc_context({"text.parse_math": False}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph", category=UserWarning)
        yield
