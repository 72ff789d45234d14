"""Numbers that have to stay below others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from reliability.family import Failure


class Check(NamedTuple):
    """A measured number.

    Attributes:
        name: what it is.
        found: its value.
        most: that it may be; None: only told.
        unit: of both.
    """

    name: str
    found: float
    most: float | None
    unit: str

    @property
    def holds(self) -> bool:
        """Whether it is no more than it may be; a number that is none never is."""
        return self.most is None or self.found <= self.most


def rows(checks: Iterable[Check]) -> tuple[dict[str, str | float], ...]:
    """Return the rows of a table."""
    return tuple(
        {
            "what": check.name,
            "found": check.found,
            "at most": "" if check.most is None else check.most,
            "unit": check.unit,
        }
        for check in checks
    )


def failures(checks: Iterable[Check]) -> tuple[Failure, ...]:
    """Return those that do not hold."""
    return tuple(
        Failure(check.name, f"{check.found:.4g} {check.unit}, more than {check.most:.4g}")
        for check in checks
        if not check.holds
    )
