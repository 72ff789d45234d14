"""`--gaussians auto`: when the population may grow, by how much, and when that no longer pays.

Optimisation improves held-out views all the time and hides what growth adds. So every stage of
growth is run twice over the same steps, without growing and with it, and the smaller population is
kept unless the larger one is better on views that neither is fitted to.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from p2gs_jax.config import DensifyConfig
from p2gs_jax.errors import UserError

# A stage makes the population this many times larger, more only where the run is short.
LEAST_FACTOR, MOST_FACTOR = 1.25, 2.0
# The grown population is kept if it gains this much, dB, for every factor of 1.25 (BUILD_NOTES).
LEAST_GAIN = 0.05
# Growth ends after this many stages in a row that did not.
PATIENCE = 2
# New Gaussians need hundreds of steps to show what they are worth (BUILD_NOTES).
FEWEST_STEPS, MOST_STEPS = 175, 400
# Before this fraction of the run the seeds are too raw to show what more of them would add.
EARLIEST, LATEST = 0.15, 0.9
SEEDS_BOUND, DEFAULT_BOUND, BOUND = 8, 4, 2_000_000


class StageResult(NamedTuple):
    """The end of a stage: the same steps with growth and without.

    Attributes:
        gaussians: population it grew to.
        psnr: of that, mean over the held-out training views, dB.
        before: population without growth.
        without: PSNR of that.
        progress: of the run.
    """

    gaussians: int
    psnr: float
    before: int
    without: float
    progress: float

    @property
    def gain(self) -> float:
        """What the stage gained, dB."""
        return self.psnr - self.without

    @property
    def kept(self) -> bool:
        """Whether that is worth the larger population."""
        factors = math.log(self.gaussians / self.before) / math.log(LEAST_FACTOR)
        return self.gain >= LEAST_GAIN * factors


class Stage(NamedTuple):
    """A stage to come.

    Attributes:
        before: population.
        factor: by which it grows.
        events: densifications; the first half of them grow, then what is new may settle.
    """

    before: int
    factor: float
    events: int

    def target(self, done: int) -> int:
        """Return the population after `done` densifications."""
        share = min(done / max(self.events // 2, 1), 1.0)
        return math.ceil(self.before * self.factor**share - 1e-9)


@dataclass
class Growth:
    """How far growth has come; part of what checkpoints remember.

    Attributes:
        results: of its stages, in order.
        limit: the population at which growth ended, or None while it goes on.
    """

    results: list[StageResult] = field(default_factory=list)
    limit: int | None = None

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Growth:
        """Return what `dataclasses.asdict` and JSON made of it."""
        saved = values.get("results", values.get("looks", []))  # as earlier versions named it
        return cls([StageResult(*stage) for stage in saved], values.get("limit"))

    @property
    def stalled(self) -> bool:
        """Whether the last stages gained too little to go on."""
        last = self.results[-PATIENCE:]
        return len(last) == PATIENCE and not any(result.kept for result in last)


def check_method(cfg: DensifyConfig) -> None:
    """Refuse automatic growth where it cannot be steered, and moves that no shrinking makes up for.

    Raises:
        UserError: `max_gaussians` is `auto` and the method is not `mcmc`, or `spread` is not in
            [0, 1).
    """
    if not 0 <= cfg.spread < 1:
        raise UserError(
            f"--densify.spread {cfg.spread:g} is not between 0 and 1 (1 excluded).",
            fix="give a share of a Gaussian's own extent, for example 0.5",
        )
    if cfg.max_gaussians == "auto" and cfg.method != "mcmc":
        raise UserError(
            f"--gaussians auto steers the growth of --densify.method mcmc, not of {cfg.method}.",
            fix="give a number (--gaussians N) or leave the option out, or add "
            "--densify.method mcmc",
        )


def upper_bound(seeds: int, default: int) -> int:
    """Return the population at which growth ends in any case.

    Args:
        seeds: initial population.
        default: limit where none is configured.
    """
    return max(min(max(SEEDS_BOUND * seeds, DEFAULT_BOUND * default), BOUND), seeds)


def window(cfg: DensifyConfig, levels: tuple[tuple[float, int], ...]) -> tuple[float, float]:
    """Return between which progresses the population grows.

    It waits for the largest images that the window reaches: at coarse ones more Gaussians show
    nothing.

    Args:
        cfg: first and last densification.
        levels: of the schedule.
    """
    stop = min(cfg.stop, LATEST)
    start = max([cfg.start, EARLIEST, *(end for end, _ in levels if end < stop)])
    return start, stop


def plan_stage(
    population: int, bound: int, steps_left: float, steps_per_event: float
) -> Stage | None:
    """Return the next stage, or None where there is no room or time for one.

    Args:
        population: to start from.
        bound: on the population.
        steps_left: in which growth may go on.
        steps_per_event: between two densifications.
    """
    room = bound / population
    if room < LEAST_FACTOR or steps_left < FEWEST_STEPS:
        return None
    stages = min(steps_left // FEWEST_STEPS, max(math.log(room) // math.log(LEAST_FACTOR), 1))
    factor = min(max(room ** (1 / stages), LEAST_FACTOR), MOST_FACTOR)
    # One of its densifications lies between this stage and the next.
    events = int(min(steps_left / stages, MOST_STEPS) / steps_per_event) - 1
    return Stage(population, factor, max(events, 2))


def describe(growth: Growth, views: int) -> str:
    """Return in words where growth ended and why."""
    if not growth.results:
        return f"Growth ended at {growth.limit} Gaussians: there was no time or room to try more."
    last = growth.results[-1]
    what = f"{last.gaussians / last.before:.2f}x of {last.before}"
    why = "" if growth.stalled else " with its time or room"
    return (
        f"Growth ended at {growth.limit} Gaussians{why}: the last stage, {what}, gained "
        f"{last.gain:.2f} dB on {views} held-out training views."
    )


def summary(growth: Growth, validation: Sequence[int]) -> dict[str, Any]:
    """Return what `metrics.json` says about growth.

    Args:
        growth: at the end of the run.
        validation: rows of the held-out training views.
    """
    results = [
        {**stage._asdict(), "gain": stage.gain, "kept": stage.kept} for stage in growth.results
    ]
    return {"limit": growth.limit, "held_out": len(validation), "looks": results}
