"""A family of trials, and its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

Report = Callable[[str], None]
"""Receives progress, a line at a time."""

COMMAND = "python experiments/reliability/run.py --only"


class Failure(NamedTuple):
    """A trial that did not end as it should."""

    name: str  # of the trial
    reason: str  # what happened instead


@dataclass(frozen=True)
class Family:
    """The results of trials of one kind."""

    name: str  # of the module
    tried: int  # how many trials
    survived: int  # how many ended as they should
    failures: tuple[Failure, ...] = ()  # the others
    command: str = ""  # repeats the family
    seconds: float = 0.0  # of the whole family
    # further numbers, rows of one table; all have the same keys
    figures: tuple[Mapping[str, str | int | float], ...] = ()
