"""`densify.method` mcmc: relocate what is transparent, grow by a factor towards a bound."""

from __future__ import annotations

import functools
import math

import jax
import numpy as np

from p2gs_jax.config import DensifyConfig
from p2gs_jax.gaussians import mcmc
from p2gs_jax.gaussians.population import Outcome, default_max_gaussians
from p2gs_jax.train.demand import demand
from p2gs_jax.train.host import HostState
from p2gs_jax.train.schedule import shrinks_left
from p2gs_jax.train.state import FitState, count_alive
from p2gs_jax.train.strategies.base import RunContext, Strategy, compiled_key

SLOTS = 1024
# Steps at full size cost about twice the present ones, at a coarse level.
FULL_SIZE_COST = 2.0


@functools.partial(jax.jit, static_argnames=("cfg", "b2"))
def relocate(key, gaussians, population, moments, births, *, cfg: DensifyConfig, b2: float):
    """Relocate, and grow towards where the loss pulls most (`mcmc.relocate_and_grow`).

    Args:
        key: randomness.
        gaussians: the scene.
        population: who is alive.
        moments: Adam's.
        births: new Gaussians wanted.
        cfg: opacity threshold, spread.
        b2: Adam's share of the old mean of the squares.
    """
    asked = demand(gaussians, moments, b2)
    return mcmc.relocate_and_grow(key, gaussians, population, births, cfg, asked)


class Mcmc(Strategy):
    """Kheradmand et al. 2024, with births where they are needed."""

    def __init__(self, run: RunContext, seeds: int):
        super().__init__(run, seeds)
        self._static = {"cfg": run.cfg.densify, "b2": run.cfg.optimizer.b2}
        self._relocate = functools.partial(relocate, **self._static)

    def bounds(self, seeds: int) -> tuple[int | None, int]:
        """Return the bound, configured or chosen, and slots for as many."""
        limit, _ = super().bounds(seeds)
        if limit is None:
            limit = default_max_gaussians(seeds, self.run.coverage, self.run.cfg.train)
        limit = max(limit, seeds)
        # Rounded: a seed more or less, known late, should not be another program.
        return limit, -(-limit // SLOTS) * SLOTS

    def expect(self, state: FitState) -> None:
        """Begin to compile the relocation."""
        slots = state.params.gaussians.capacity
        self._relocate = self.run.programs.ahead(
            ("relocate", *self._static.values(), slots),
            relocate,
            compiled_key.eval_shape(np.uint32(0), np.int32(0)),
            state.params.gaussians,
            state.population,
            state.opt_state.gaussians[0],
            np.int32(0),
            **self._static,
        )

    def densify(self, state: FitState, host: HostState) -> FitState:
        """Relocate, and grow on the way to the bound."""
        alive = count_alive(state)
        births = max(self._target(alive, host) - alive, 0)
        outcome: Outcome = self._relocate(
            self.key(host),
            state.params.gaussians,
            state.population,
            state.opt_state.gaussians[0],
            np.int32(births),
        )
        return self.settled(state, outcome, host)

    def _target(self, alive: int, host: HostState) -> int:
        """Return the population after the next relocation."""
        limit = self._affordable(alive, host)
        room = max((limit or alive) / max(alive, 1), 1.0)
        # The limit is reached at the last event: what is born earlier costs more steps.
        events = (self.run.cfg.densify.stop - host.progress) / self.interval(host)
        factor = max(self.run.cfg.densify.growth, room ** (1 / max(events, 1.0)))
        return min(math.ceil(alive * factor), limit or alive)

    def _affordable(self, alive: int, host: HostState) -> int | None:
        """Return the bound on the population that the pace of this machine allows.

        Where the bound was chosen for a time budget, it was chosen for an unloaded machine.
        """
        cfg, limit = self.run.cfg, self.limit
        chosen = cfg.densify.max_gaussians is None and cfg.train.budget_s is not None
        if not chosen or limit is None or host.step_s <= 0:
            return limit
        left = (1.0 - host.progress) / host.pace
        later = any(s < host.shrink for s in shrinks_left(host.progress, self.run.levels))
        steps = host.step + (left / FULL_SIZE_COST if later else left)
        return max(alive, min(limit, self.run.coverage.gaussians(steps)))
