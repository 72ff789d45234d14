"""How far a long stage is, and how long the rest takes at its pace."""

from __future__ import annotations

import time
from collections.abc import Callable

# Seconds between two messages.
EVERY_S = 10.0


class Pace:
    """Reports a stage now and then; the first message comes at once."""

    def __init__(
        self,
        report: Callable[[str], None],
        stage: str,
        total: int,
        unit: str,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Begin the stage.

        Args:
            report: receives messages.
            stage: what is being done.
            total: how many there are.
            unit: of what.
            clock: seconds.
        """
        self._report, self._stage, self._total, self._unit = report, stage, total, unit
        self._clock = clock
        self._begin = self._last = clock()
        if total:
            report(f"{stage}: {total} {unit}")

    def __call__(self, done: int) -> None:
        """Say how many are done, unless something was said just before."""
        now = self._clock()
        if now - self._last < EVERY_S or not 0 < done < self._total:
            return
        self._last = now
        left = (now - self._begin) / done * max(self._total - done, 0)
        self._report(
            f"{self._stage}: {done} of {self._total} {self._unit}, about {_clock(left)} left at "
            "this pace"
        )


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
