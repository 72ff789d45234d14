"""What a family of trials is, and what it found."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

Report = Callable[[str], None]
"""Receives progress, a line at a time."""

COMMAND = "python experiments/reliability/run.py --only"


class Failure(NamedTuple):
    """A trial that was not survived.

    Attributes:
        name: of the trial.
        reason: what happened instead.
    """

    name: str
    reason: str


@dataclass(frozen=True)
class Family:
    """What trials of one kind found.

    Attributes:
        name: of the module.
        tried: how many trials.
        survived: how many ended as they should.
        failures: the others.
        command: that repeats it.
        seconds: that it took.
        figures: further numbers, rows of one table; all have the same keys.
    """

    name: str
    tried: int
    survived: int
    failures: tuple[Failure, ...] = ()
    command: str = ""
    seconds: float = 0.0
    figures: tuple[Mapping[str, str | int | float], ...] = ()
