"""Text of others, such as file names, shown so that a terminal only shows it."""

from __future__ import annotations

import re

# Control characters but tab and newline, surrogates, and what turns the direction of writing.
_HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    r"""Return a text whose control characters are written out, as `\x1b`."""
    return _HIDDEN.sub(lambda found: ascii(found.group())[1:-1], text)
