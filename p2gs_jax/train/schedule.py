"""Schedules of a run as functions of the fraction completed, and its time budget.

Every schedule reads `progress` in [0, 1] instead of a step number. So a run meets a wall-clock
budget by changing only the progress per step.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from p2gs_jax.config import TrainConfig
from p2gs_jax.train.state import HostState

MIN_LEVEL_PIXELS = 96  # least shorter side of the images of a level
# The progress per step grows at most by this factor at once, and leaves at least so many steps.
MIN_STEPS_LEFT, MAX_SPEED_UP = 8, 1.5
# Time of a step relative to a step at half the image width (measured: 1.6 to 2.8).
COST_OF_A_LEVEL = 2.0
# Upper bound of the estimated slowdown relative to an unloaded machine.
MOST_SLOWNESS = 3.0

# Progress at the end of each level, and the factor by which it shrinks images; in order.
Levels = tuple[tuple[float, int], ...]


def shrinks(cfg: TrainConfig) -> tuple[int, ...]:
    """Return the factors by which the levels shrink images, in order; the last is 1."""
    return tuple(2**k for k in range(len(cfg.coarse_to_fine), -1, -1))


def levels(cfg: TrainConfig, width: int, height: int) -> Levels:
    """Return the levels of the schedule, for images of this width and height in pixels.

    Levels are left out if the shorter side of their images would have less than 96 pixels.
    """
    kept = [
        (end, shrink)
        for end, shrink in zip(cfg.coarse_to_fine, shrinks(cfg)[:-1], strict=True)
        if min(width, height) // shrink >= MIN_LEVEL_PIXELS
    ]
    return (*kept, (1.0, 1))


def shrink_at(progress: float, plan: Levels) -> int:
    """Return the factor by which images are shrunk at this progress."""
    return next((shrink for end, shrink in plan if progress < end), 1)


def shrinks_left(progress: float, plan: Levels) -> list[int]:
    """Return the shrink factors of the levels that are not over, in order."""
    return [shrink for end, shrink in plan if end > progress]


def seconds_left(progress: float, per_step: float, step_s: float, plan: Levels) -> float:
    """Return an estimate of the seconds that the remaining steps take.

    Steps at the present level take `step_s` seconds; at finer levels they take COST_OF_A_LEVEL
    times as long per level. `per_step` is the progress of one step.
    """
    present, total = shrink_at(progress, plan), 0.0
    for end, shrink in plan:
        steps = max(end - progress, 0.0) / per_step
        total += steps * step_s * COST_OF_A_LEVEL ** math.log2(present / shrink)
        progress = max(progress, end)
    return total


def is_over(progress: float, per_step: float) -> bool:
    """Return whether a run is complete, up to half a step; `per_step` is the progress of a step."""
    return progress >= 1.0 - 0.5 * per_step


def sh_degree_at(progress: float, cfg: TrainConfig, highest: int) -> int:
    """Return the spherical-harmonics degree in use (3DGS: one more every 1,000 of 30,000 steps)."""
    return min(highest, int(progress / cfg.sh_every + 1e-9))


def highest_degree(shrink: int, plan: Levels, cfg: TrainConfig, highest: int) -> int:
    """Return the highest spherical-harmonics degree that a level uses."""
    end = next((end for end, factor in plan if factor == shrink), 1.0)
    return sh_degree_at(end, cfg, highest)


def rate_factor(per_step: float, visible_share: float, most_updates: float | None) -> float:
    """Return the factor, at most 1, on the learning rates of Gaussians except colours.

    Near an optimum the noise of Adam's steps grows with their number times the squared learning
    rate. So long fits divide rates by the root of their length (ours: BUILD_NOTES, "Length").
    `visible_share` is the share of the Gaussians that a view shows. The configured rates hold up to
    `most_updates` updates of a Gaussian; None: always.
    """
    if most_updates is None:
        return 1.0
    return min(1.0, (most_updates * per_step / visible_share) ** 0.5)


def replanned(per_step: float, progress: float, left_s: float, step_s: float) -> float:
    """Return the progress per step with which the run ends on time.

    Under a budget, progress is the share of time. Every level gets its share of the seconds,
    whatever its steps cost, and compilation counts as time. Steps so far made `per_step` progress
    each and took `step_s` seconds; the deadline is in `left_s` seconds.
    """
    wanted = (1.0 - progress) * step_s / max(left_s, 1e-3)
    # One slow burst, for example with a page fault, must not use up the schedule.
    bounded = min(wanted, MAX_SPEED_UP * per_step, (1.0 - progress) / MIN_STEPS_LEFT)
    return max(bounded, 1e-9)


class RunClock:
    """The clock of one session, and the deadline of the run that it continues.

    A budget loses `spent_s` seconds used before the run. It reserves `finish_s` seconds for
    evaluation and export on an unloaded machine, where a step at full size takes `full_step_s`
    seconds. `now` is a monotonic clock in seconds. `deadline_s` is the time since the start of the
    run at which optimisation must end, at least 5 seconds; None without a budget.
    """

    def __init__(
        self,
        cfg: TrainConfig,
        host: HostState,
        *,
        spent_s: float = 0.0,
        finish_s: float = 0.0,
        full_step_s: float = 1.0,
        now: Callable[[], float] = time.monotonic,
    ):
        self.deadline_s = None
        if cfg.budget_s is not None:
            self.deadline_s = max(cfg.budget_s - spent_s - finish_s, 5.0)
        self.now, self._finish_s, self._full_step_s = now, finish_s, full_step_s
        self._before, self._begun = host.elapsed_s, now()

    def tick(self, host: HostState) -> None:
        """Store the elapsed time in the counters."""
        host.elapsed_s = self._before + self.now() - self._begun

    def replan(self, host: HostState) -> None:
        """Set the progress per step with which the run ends on time, if there is a budget."""
        if self.deadline_s is None or host.step_s <= 0:
            return
        left = self.deadline_s - self._passed(host)
        host.pace = replanned(host.pace, host.progress, left, host.step_s)

    def left(self, host: HostState, plan: Levels) -> float | None:
        """Return an estimate of the seconds left; None without a budget before a step is timed."""
        if self.deadline_s is not None:
            return max(self.deadline_s - self._passed(host), 0.0)
        if host.step_s <= 0:
            return None
        return seconds_left(host.progress, host.pace, host.step_s, plan)

    def over(self, host: HostState) -> bool:
        """Return whether the time for optimisation is used up."""
        return self._passed(host) > (self.deadline_s or math.inf)

    def _passed(self, host: HostState) -> float:
        """Return the elapsed seconds, plus the time that the final work needs beyond its reserve.

        The estimate assumes that evaluation is slowed down by the same factor as full-size steps.
        """
        slowness = 1.0
        if host.shrink == 1 and host.step_s > 0:
            slowness = min(max(host.step_s / self._full_step_s, 1.0), MOST_SLOWNESS)
        return host.elapsed_s + self._finish_s * (slowness - 1)
