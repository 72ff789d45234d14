"""What changes as a run proceeds, as functions of the fraction completed; and the time budget.

Every schedule reads `progress` in [0, 1] instead of a step number, so a run can be fitted to a
wall-clock budget by changing only how much progress one step makes.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from p2gs_jax.config import TrainConfig

MIN_LEVEL_PIXELS = 96
MIN_STEPS_LEFT = 8
MAX_SPEED_UP = 1.5
# Seconds of a step over those at half the width, late in it (ours: 1.6 to 2.8 on photographs).
COST_OF_A_LEVEL = 2.0

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

    Steps of every level count as a multiple of the present ones: finer ones cost more.

    Args:
        progress: fraction completed.
        per_step: progress of one step.
        step_s: measured seconds per step at the present level.
        plan: the levels.
    """
    present, total = shrink_at(progress, plan), 0.0
    for end, shrink in plan:
        steps = max(end - progress, 0.0) / per_step
        total += steps * step_s * COST_OF_A_LEVEL ** math.log2(present / shrink)
        progress = max(progress, end)
    return total


def is_over(progress: float, per_step: float) -> bool:
    """Return whether a run is complete, up to half a step.

    Args:
        progress: fraction completed.
        per_step: progress of one step.
    """
    return progress >= 1.0 - 0.5 * per_step


def sh_degree_at(progress: float, cfg: TrainConfig, highest: int) -> int:
    """Return the spherical-harmonics degree in use (3DGS: one more every 1000 of 30k steps)."""
    return min(highest, int(progress / cfg.sh_every + 1e-9))


def rate_factor(per_step: float, shown: float, settled: float | None) -> float:
    """Return the factor on rates of Gaussians but for colours in a fit of this length, at most 1.

    Near an optimum the noise of Adam's steps adds up as their number times the squared rate: so
    long fits take rates lower by the root of their length (ours: BUILD_NOTES, "Length").

    Args:
        per_step: progress of one step.
        shown: share of the Gaussians that one step updates, about.
        settled: updates of a Gaussian up to which the configured rates hold; None: any number.
    """
    if settled is None:
        return 1.0
    return min(1.0, (settled * per_step / shown) ** 0.5)


@dataclass(frozen=True)
class Pace:
    """How much progress a step makes, and what is known about its cost.

    Attributes:
        per_step: progress of one step.
        deadline_s: seconds into the run at which optimisation must end, or None.
    """

    per_step: float
    deadline_s: float | None = None

    @classmethod
    def from_config(cls, cfg: TrainConfig, reserve_s: float) -> Pace:
        """Return the pace before anything was measured.

        Args:
            cfg: steps or budget.
            reserve_s: seconds to keep for evaluation and files after the last step.
        """
        deadline = None if cfg.budget_s is None else max(cfg.budget_s - reserve_s, 5.0)
        return cls(1.0 / max(cfg.steps, 1), deadline)

    def replan(self, progress: float, elapsed_s: float, step_s: float) -> Pace:
        """Return the pace at which the run ends on time.

        Under a budget, progress is the share of time: every level of the schedule gets its share
        of the seconds, whatever its steps cost, and compilation counts like any other second.

        Args:
            progress: where the run is.
            elapsed_s: seconds since the run began.
            step_s: measured seconds per step at the present level.
        """
        if self.deadline_s is None:
            return self
        left = max(self.deadline_s - elapsed_s, 1e-3)
        wanted = (1.0 - progress) * step_s / left
        # One slow burst (another program, a page fault) must not use up the schedule.
        bounded = min(wanted, MAX_SPEED_UP * self.per_step, (1.0 - progress) / MIN_STEPS_LEFT)
        return dataclasses.replace(self, per_step=max(bounded, 1e-9))
