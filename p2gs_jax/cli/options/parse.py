"""Parsers of option values that are words rather than numbers."""

from __future__ import annotations

import re

from p2gs_jax.errors import UserError


def parse_duration(text: str) -> float:
    """Return seconds of `90`, `90s`, `5m`, `1h30m`.

    Raises:
        UserError: the text is no duration.
    """
    match = re.fullmatch(r"(?:(\d+)h)?(?:(\d+(?:\.\d+)?)m)?(?:(\d+(?:\.\d+)?)s?)?", text.strip())
    if match is None or not any(match.groups()):
        raise UserError(f"--budget {text!r} is no duration.", fix="write 90s, 5m or 1h30m")
    hours, minutes, seconds = (float(g or 0) for g in match.groups())
    total = 3600 * hours + 60 * minutes + seconds
    if total <= 0:
        raise UserError(f"--budget {text!r} leaves no time.", fix="write 90s, 5m or 1h30m")
    return total


def parse_gaussians(text: str) -> int:
    """Return the value of `--gaussians`.

    Raises:
        UserError: it is not a whole number from 1 on.
    """
    if re.fullmatch(r"\d+", text) is None or int(text) < 1:
        raise UserError(
            f"--gaussians {text!r} is not a number of Gaussians.",
            fix="write a whole number from 1 on",
        )
    return int(text)


def check(condition: bool, text: str, *, fix: str | None = None) -> None:
    """Raise an error unless the condition holds.

    Raises:
        UserError: it does not.
    """
    if not condition:
        raise UserError(text + ".", fix=fix)
