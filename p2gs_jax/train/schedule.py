"""What changes as a run proceeds, as functions of the fraction completed; and the time budget.

Every schedule reads `progress` in [0, 1] instead of a step number, so a run can be fitted to a
wall-clock budget by changing only how much progress one step makes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from p2gs_jax.config import TrainConfig
from p2gs_jax.train.state import HostState

MIN_LEVEL_PIXELS = 96
MIN_STEPS_LEFT = 8
MAX_SPEED_UP = 1.5
# Seconds of a step over those at half the width, late in it (ours: 1.6 to 2.8 on photographs).
COST_OF_A_LEVEL = 2.0
# How many times slower than an unloaded machine this one may be taken for.
MOST_SLOWNESS = 3.0

# End of each level as a progress, and the factor by which its images are shrunk; in order.
Levels = tuple[tuple[float, int], ...]


def shrinks(cfg: TrainConfig) -> tuple[int, ...]:
    """Return the factors by which images are shrunk, level by level; the last is 1."""
    return tuple(2**k for k in range(len(cfg.coarse_to_fine), -1, -1))


def levels(cfg: TrainConfig, width: int, height: int) -> Levels:
    """Return the levels of the schedule.

    Those that would make images smaller than 96 pixels across are left out.
    """
    kept = [
        (end, shrink)
        for end, shrink in zip(cfg.coarse_to_fine, shrinks(cfg)[:-1], strict=True)
        if min(width, height) // shrink >= MIN_LEVEL_PIXELS
    ]
    return (*kept, (1.0, 1))


def shrink_at(progress: float, plan: Levels) -> int:
    """Return the factor by which images are shrunk at this point of the run."""
    return next((shrink for end, shrink in plan if progress < end), 1)


def shrinks_left(progress: float, plan: Levels) -> list[int]:
    """Return the factors of the levels that are not over, in order."""
    return [shrink for end, shrink in plan if end > progress]


def seconds_left(progress: float, per_step: float, step_s: float, plan: Levels) -> float:
    """Return about how many seconds the steps to come take.

    Steps of every level count as a multiple of the present ones, which take `step_s` seconds: finer
    ones cost more. `per_step` is the progress of one step.
    """
    present, total = shrink_at(progress, plan), 0.0
    for end, shrink in plan:
        steps = max(end - progress, 0.0) / per_step
        total += steps * step_s * COST_OF_A_LEVEL ** math.log2(present / shrink)
        progress = max(progress, end)
    return total


def is_over(progress: float, per_step: float) -> bool:
    """Return whether a run is complete, up to half a step; `per_step` is the progress of one."""
    return progress >= 1.0 - 0.5 * per_step


def sh_degree_at(progress: float, cfg: TrainConfig, highest: int) -> int:
    """Return the spherical-harmonics degree in use (3DGS: one more every 1000 of 30k steps)."""
    return min(highest, int(progress / cfg.sh_every + 1e-9))


def highest_degree(shrink: int, plan: Levels, cfg: TrainConfig, highest: int) -> int:
    """Return the highest spherical-harmonics degree that a level uses."""
    end = next((end for end, factor in plan if factor == shrink), 1.0)
    return sh_degree_at(end, cfg, highest)


def rate_factor(per_step: float, shown: float, settled: float | None) -> float:
    """Return the factor on rates of Gaussians but for colours in a fit of this length, at most 1.

    Near an optimum the noise of Adam's steps adds up as their number times the squared rate: so
    long fits take rates lower by the root of their length (ours: BUILD_NOTES, "Length"). `shown` is
    the share of the Gaussians that one step updates, `settled` the updates of a Gaussian up to
    which the configured rates hold; None: any number.
    """
    if settled is None:
        return 1.0
    return min(1.0, (settled * per_step / shown) ** 0.5)


def replanned(per_step: float, progress: float, left_s: float, step_s: float) -> float:
    """Return the progress of a step with which the run ends on time.

    Under a budget, progress is the share of time: every level of the schedule gets its share of the
    seconds, whatever its steps cost, and compilation counts like any other second. Until now a step
    made `per_step` and takes `step_s` seconds; the deadline is in `left_s` seconds.
    """
    wanted = (1.0 - progress) * step_s / max(left_s, 1e-3)
    # One slow burst (another program, a page fault) must not use up the schedule.
    bounded = min(wanted, MAX_SPEED_UP * per_step, (1.0 - progress) / MIN_STEPS_LEFT)
    return max(bounded, 1e-9)


class RunClock:
    """The clock of one session, and the deadline of the run that it continues.

    Of a budget `spent_s` seconds were gone before the run, and `finish_s` are left for what
    follows, on an unloaded machine, where a step at full size takes `full_step_s`. `now` gives
    seconds on a clock that never goes back. `deadline_s` are the seconds into the run at which
    optimisation must end; None without a budget.
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
        """Write down how much time has passed."""
        host.elapsed_s = self._before + self.now() - self._begun

    def replan(self, host: HostState) -> None:
        """Set the pace with which the run ends on time; without a budget it stays."""
        if self.deadline_s is None or host.step_s <= 0:
            return
        left = self.deadline_s - self._passed(host)
        host.pace = replanned(host.pace, host.progress, left, host.step_s)

    def left(self, host: HostState, plan: Levels) -> float | None:
        """Return about how many seconds optimisation still takes, None where no step was timed."""
        if self.deadline_s is not None:
            return max(self.deadline_s - self._passed(host), 0.0)
        if host.step_s <= 0:
            return None
        return seconds_left(host.progress, host.pace, host.step_s, plan)

    def over(self, host: HostState) -> bool:
        """Return whether the time that optimisation may take is used up."""
        return self._passed(host) > (self.deadline_s or math.inf)

    def _passed(self, host: HostState) -> float:
        """Return the seconds so far, and by how much what follows will exceed its reserve.

        Evaluation is taken to be as much slower than expected as the steps are.
        """
        return host.elapsed_s + self._finish_s * (self._slowness(host) - 1)

    def _slowness(self, host: HostState) -> float:
        """Return how many times slower than expected full-size steps are, from 1 to 3."""
        if host.shrink != 1 or host.step_s <= 0:
            return 1.0
        return min(max(host.step_s / self._full_step_s, 1.0), MOST_SLOWNESS)
