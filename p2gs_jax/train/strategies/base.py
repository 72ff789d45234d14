"""What a densification strategy is: one hook after every burst."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from p2gs_jax.config import FitConfig
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.streams import densification_key, device_seed
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.population import Coverage, Outcome
from p2gs_jax.train.data_parallel import Spread
from p2gs_jax.train.host import HostState
from p2gs_jax.train.optimizer import zero_moments
from p2gs_jax.train.programs import StepPrograms
from p2gs_jax.train.schedule import Levels
from p2gs_jax.train.state import FitState, count_alive, replace_gaussians
from p2gs_jax.train.views import TrainingViews

compiled_key = jax.jit(densification_key)
_zero_moments = jax.jit(zero_moments)


@dataclass(frozen=True)
class RunContext:
    """What strategies know of a run, and may use.

    Attributes:
        cfg: everything.
        extent: scene extent, scene units.
        coverage: how much of the scene the views show.
        levels: of the schedule.
        views: the training views.
        programs: compiles ahead.
        spread: how the state lies on the devices between its changes.
        clock: receives seconds by name.
        on_message: told what the user must know.
    """

    cfg: FitConfig
    extent: float
    coverage: Coverage
    levels: Levels
    views: TrainingViews
    programs: StepPrograms
    spread: Spread
    clock: Stopwatch
    on_message: Callable[[str], None]


class Strategy:
    """Keeps the seeds: nothing is born, nothing dies. Others override `densify`.

    Attributes:
        limit: bound on the population, or None where there is none.
        slots: room of the population to begin with.
        slots_stay: they do not change during the run, so that its steps can be compiled ahead.
    """

    slots_stay = True

    def __init__(self, run: RunContext, seeds: int):
        """Prepare.

        Args:
            run: what the strategy may use.
            seeds: initial population.
        """
        self.run = run
        self.limit, self.slots = self.bounds(seeds)

    def bounds(self, seeds: int) -> tuple[int | None, int]:
        """Return `limit` and `slots` for an initial population."""
        return self.run.cfg.densify.max_gaussians, seeds

    @property
    def most(self) -> int:
        """The largest population to make room for."""
        return max(self.limit or 0, self.slots)

    def expect(self, state: FitState) -> None:
        """Begin to compile what is wanted soon after the first step.

        Args:
            state: of the first step, or its shapes.
        """

    def update(self, state: FitState, host: HostState) -> FitState:
        """Change the population where it is time to; called after every burst.

        Args:
            state: after the burst; donated.
            host: counters; changed.

        Raises:
            UserError: no Gaussian is left.
        """
        with self.run.clock("densification"):
            if self.is_due(host):
                host.densified_at = host.progress
                spread = self.run.spread
                state = spread.spread(self.densify(spread.whole(state), host))
        return state

    def densify(self, state: FitState, host: HostState) -> FitState:
        """Return the state with another population; called when it is due."""
        return state

    # -------------------------------------------------------------- for those that densify

    def is_due(self, host: HostState) -> bool:
        """Return whether it is time for a densification."""
        d = self.run.cfg.densify
        within = d.method is not None and d.start <= host.progress < d.stop
        return within and host.progress - host.densified_at >= self.interval(host)

    def interval(self, host: HostState) -> float:
        """Return the progress between two densifications."""
        d = self.run.cfg.densify
        return max(d.every, d.min_every_steps * host.pace)

    def key(self, host: HostState) -> PRNGKeyArray:
        """Return the randomness of the densification after this step."""
        return compiled_key(device_seed(self.run.cfg.train.seed), np.int32(host.step))

    def settled(self, state: FitState, outcome: Outcome, host: HostState) -> FitState:
        """Return the state with a new population; moments of new Gaussians are zero.

        Raises:
            UserError: no Gaussian is left.
        """
        refused = int(outcome.refused)
        if refused > 0:
            if host.refused == 0:
                self.run.on_message(
                    f"Step {host.step}: {refused} Gaussians wanted to grow but the limit is "
                    "reached; raise --densify.max-gaussians to let them. Counted from here on."
                )
            host.refused += refused
        opt_state = _zero_moments(state.opt_state, outcome.reset_moments)
        state = replace_gaussians(state, outcome.gaussians, outcome.population, opt_state)
        if count_alive(state) == 0:
            raise UserError(
                f"Step {host.step}: densification removed every Gaussian.",
                fix="lower --densify.prune-opacity or raise --densify.prune-scale",
            )
        return state
