"""The time of a session: what has passed, how fast the run must go, and when it must end."""

from __future__ import annotations

import dataclasses
import math
import time

from p2gs_jax.train.host import HostState
from p2gs_jax.train.schedule import Levels, Pace, seconds_left

# How many times slower than an unloaded machine this one may be taken for.
MOST_SLOWNESS = 3.0


class Session:
    """The clock of one call, and the deadline of the run that it continues.

    Attributes:
        pace: progress a step, and the deadline.
    """

    def __init__(self, pace: Pace, host: HostState, *, finish_s: float, full_step_s: float):
        """Begin now.

        Args:
            pace: of the run.
            host: for the seconds of earlier sessions.
            finish_s: seconds of the budget to leave for what follows, on an unloaded machine.
            full_step_s: seconds of a step at full size there.
        """
        self.pace = pace
        self._finish_s, self._full_step_s = finish_s, full_step_s
        self._before, self._begun = host.elapsed_s, time.monotonic()

    def tick(self, host: HostState) -> None:
        """Write down how much time has passed."""
        host.elapsed_s = self._before + time.monotonic() - self._begun

    def replan(self, host: HostState) -> None:
        """Set the pace at which the run ends on time; without a budget it stays."""
        if self.pace.deadline_s is None or host.step_s <= 0:
            return
        pace = dataclasses.replace(self.pace, per_step=host.pace)
        self.pace = pace.replan(host.progress, self._passed(host), host.step_s)
        host.pace = self.pace.per_step

    def left(self, host: HostState, plan: Levels) -> float | None:
        """Return about how many seconds optimisation still takes, None where no step was timed."""
        if self.pace.deadline_s is not None:
            return max(self.pace.deadline_s - self._passed(host), 0.0)
        if host.step_s <= 0:
            return None
        return seconds_left(host.progress, host.pace, host.step_s, plan)

    def over(self, host: HostState) -> bool:
        """Return whether the time that optimisation may take is used up."""
        return self._passed(host) > (self.pace.deadline_s or math.inf)

    def _passed(self, host: HostState) -> float:
        """Return the seconds so far, and those that what follows takes more than was reserved.

        It is as slow as the steps are.
        """
        return host.elapsed_s + self._finish_s * (self._slowness(host) - 1)

    def _slowness(self, host: HostState) -> float:
        """Return how many times slower than expected full-size steps are, from 1 to 3."""
        if host.shrink != 1 or host.step_s <= 0:
            return 1.0
        return min(max(host.step_s / self._full_step_s, 1.0), MOST_SLOWNESS)
