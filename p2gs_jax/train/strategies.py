"""Densification: when the population changes, and how (gsplat's word is strategy).

A strategy is any object with the methods of `Strategy`; yours is passed to `make_step` or `fit`. It
is asked within the time and at the interval of `DensifyConfig`. What decides who is born and who
dies is pure: Gaussians and population in, an `Outcome` out.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from p2gs_jax.config import DensifyConfig, FitConfig
from p2gs_jax.core.streams import densification_key, device_seed
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians import adaptive, mcmc
from p2gs_jax.gaussians.population import (
    Coverage,
    Outcome,
    bucket_for,
    default_max_gaussians,
    empty_gaussians,
    empty_population,
    grow,
)
from p2gs_jax.train.optimizer import AdamState, zero_moments, zero_opacity_moments
from p2gs_jax.train.schedule import Levels, shrinks_left
from p2gs_jax.train.state import FitState, HostState, alive_in, grow_state
from p2gs_jax.types import Array, Gaussians, Population

SLOTS = 1024
# Steps at full size cost about twice the present ones, at a coarse level.
FULL_SIZE_COST = 2.0


class Slots(NamedTuple):
    """How large a population may become."""

    limit: int | None  # bound on it, or None where there is none
    slots: int  # room to begin with

    @property
    def most(self) -> int:
        """The largest population to make room for."""
        return max(self.limit or 0, self.slots)


class Moment(NamedTuple):
    """What a strategy is told when it is asked."""

    key: PRNGKeyArray  # randomness of this densification
    moments: AdamState  # Adam's of the Gaussians
    extent: float  # scene extent, scene units
    interval: float  # progress between two densifications
    limit: int | None  # bound on the population, or None
    # step, progress, pace and counters; a strategy that resets opacities sets `reset_at`
    host: HostState


@runtime_checkable
class Strategy(Protocol):
    """When asked, gives another population.

    Two attributes are looked at where they are there. `noise`: scale of the exploration noise that
    steps add to the means; None (default): none, and `Population` sums screen-space gradients
    instead. `slots_stay`: the number of slots never changes, so that steps can be compiled ahead
    (default: True).
    """

    def start(self, seeds: int) -> int | Slots:
        """Return room for the population, at least as many as there are seeds."""
        ...

    def densify(self, gaussians: Gaussians, population: Population, now: Moment) -> Outcome:
        """Return the population from here on, with as many slots or more.

        Moments of slots in `Outcome.reset_moments` begin anew; statistics of the population do
        where it returns `fresh_population`.
        """
        ...


def demand(gaussians: Gaussians, moments: AdamState, b2: float) -> Float[Array, " n"]:
    """Return how much the loss still pulls at each Gaussian; 0 for those that no step has seen.

    The root mean square, over the views that showed it, of the loss's gradient by a move in units
    of its own largest extent: where views pull a Gaussian to and fro, one is too few. 3DGS splits
    by the mean length of the same gradient on the screen (ours: BUILD_NOTES, "Births where they
    are needed"). `b2` is Adam's share of the old mean of the squares.
    """
    square = jnp.sum(moments.nu.means, -1)
    share = 1 - b2 ** moments.counts.astype(jnp.float32)
    seen = moments.counts > 0
    mean_square = jnp.where(seen, square / jnp.where(seen, share, 1.0), 0.0)
    found = jnp.sqrt(mean_square) * jnp.exp(jnp.max(gaussians.log_scales, -1))
    return jnp.where(jnp.isfinite(found), found, 0.0)


@functools.partial(jax.jit, static_argnames=("cfg", "b2"))
def relocate(key, gaussians, population, moments, births, *, cfg: DensifyConfig, b2: float):
    """Relocate, and grow by `births` where the loss pulls most (`mcmc.relocate_and_grow`)."""
    asked = demand(gaussians, moments, b2)
    return mcmc.relocate_and_grow(key, gaussians, population, births, cfg, asked)


class Mcmc:
    """`densify.method` mcmc: Kheradmand et al. 2024, with births where they are needed.

    Relocates what is transparent, and grows by a factor towards a bound.
    """

    slots_stay = True

    def __init__(self, cfg: FitConfig, coverage: Coverage, levels: Levels):
        self.cfg, self.coverage, self.levels = cfg, coverage, levels
        self.noise = cfg.densify.noise
        self._static = {"cfg": cfg.densify, "b2": cfg.optimizer.b2}
        self._relocate: Callable[..., Outcome] = functools.partial(relocate, **self._static)

    def start(self, seeds: int) -> Slots:
        """Return the bound, configured or chosen, and slots for as many."""
        limit = self.cfg.densify.max_gaussians
        if limit is None:
            limit = default_max_gaussians(seeds, self.coverage, self.cfg.train)
        limit = max(limit, seeds)
        # Rounded: a seed more or less, known late, should not be another program.
        return Slots(limit, -(-limit // SLOTS) * SLOTS)

    def expect(self, programs: Any, state: FitState) -> None:
        """Begin to compile the relocation of a state of these shapes; `programs` compiles ahead."""
        gaussians = state.params.gaussians
        key = compiled_key.eval_shape(np.uint32(0), np.int32(0))
        self._relocate = programs.ahead(
            ("relocate", *self._static.values(), gaussians.capacity),
            relocate,
            key,
            gaussians,
            state.population,
            state.opt_state.gaussians,
            np.int32(0),
            **self._static,
        )

    def densify(self, gaussians: Gaussians, population: Population, now: Moment) -> Outcome:
        """Relocate, and grow on the way to the bound."""
        alive = alive_in(population)
        births = np.int32(max(self._target(alive, now) - alive, 0))
        return self._relocate(now.key, gaussians, population, now.moments, births)

    def _target(self, alive: int, now: Moment) -> int:
        """Return the population after the next relocation."""
        limit = self._affordable(alive, now)
        room = max((limit or alive) / max(alive, 1), 1.0)
        # The limit is reached at the last event: what is born earlier costs more steps.
        events = (self.cfg.densify.stop - now.host.progress) / now.interval
        factor = max(self.cfg.densify.growth, room ** (1 / max(events, 1.0)))
        return min(math.ceil(alive * factor), limit or alive)

    def _affordable(self, alive: int, now: Moment) -> int | None:
        """Return the bound on the population that the pace of this machine allows.

        Where the bound was chosen for a time budget, it was chosen for an unloaded machine.
        """
        cfg, limit, host = self.cfg, now.limit, now.host
        chosen = cfg.densify.max_gaussians is None and cfg.train.budget_s is not None
        if not chosen or limit is None or host.step_s <= 0:
            return limit
        left = (1.0 - host.progress) / host.pace
        later = any(s < host.shrink for s in shrinks_left(host.progress, self.levels))
        steps = host.step + (left / FULL_SIZE_COST if later else left)
        return max(alive, min(limit, self.coverage.gaussians(steps)))


_propose = jax.jit(adaptive.propose, static_argnames="cfg")
_apply = jax.jit(adaptive.apply)


class Adaptive:
    """`densify.method` adaptive: clones, splits, pruning and opacity resets (Kerbl et al. 2023).

    The paper's. Slots follow the population.
    """

    noise = None
    slots_stay = False

    def __init__(self, cfg: FitConfig):
        self.cfg = cfg.densify

    def start(self, seeds: int) -> Slots:
        """Return slots for the seeds."""
        return Slots(self.cfg.max_gaussians, seeds)

    def densify(self, gaussians: Gaussians, population: Population, now: Moment) -> Outcome:
        """Prune, clone and split; reset opacities where it is time to."""
        d, host = self.cfg, now.host
        proposal = _propose(gaussians, population, now.extent, host.reset_at > 0, cfg=d)
        before = gaussians.capacity
        capacity = bucket_for(int(proposal.wanted), before, now.limit)
        if now.limit is not None:
            capacity = min(capacity, max(now.limit, before))
        if capacity > before:
            empty = empty_gaussians(capacity - before, gaussians)
            gaussians = grow(gaussians, empty)
            population = grow(population, empty_population(capacity - before, population))
            new = jnp.zeros(capacity - before, bool)
            proposal = jax.tree.map(lambda a: jnp.concatenate([a, new]) if a.ndim else a, proposal)
        outcome = _apply(now.key, gaussians, population, proposal)
        if host.progress - host.reset_at >= max(d.reset_every, d.min_reset_steps * host.pace):
            host.reset_at = host.progress
            return outcome._replace(gaussians=adaptive.reset_opacities(outcome.gaussians))
        return outcome


def make_strategy(cfg: FitConfig, coverage: Coverage, levels: Levels) -> Strategy | None:
    """Return the strategy that `DensifyConfig` asks for; None: nothing is born, nothing dies."""
    if cfg.densify.method == "mcmc":
        return Mcmc(cfg, coverage, levels)
    return None if cfg.densify.method is None else Adaptive(cfg)


def started(strategy: Strategy | None, seeds: int) -> Slots:
    """Return the slots of a strategy, which may have given a number only."""
    found = Slots(None, seeds) if strategy is None else strategy.start(seeds)
    return found if isinstance(found, Slots) else Slots(found, found)


def interval(d: DensifyConfig, host: HostState) -> float:
    """Return the progress between two densifications."""
    return max(d.every, d.min_every_steps * host.pace)


def is_due(d: DensifyConfig, host: HostState) -> bool:
    """Return whether it is time for a densification."""
    within = d.start <= host.progress < d.stop
    return within and host.progress - host.densified_at >= interval(d, host)


compiled_key = jax.jit(densification_key)
_zero_moments = jax.jit(zero_moments)


def densified(
    strategy: Strategy,
    state: FitState,
    host: HostState,
    cfg: FitConfig,
    extent: float,
    limit: int | None,
    on_message: Callable[[str], None],
) -> FitState:
    """Return the state after a densification; moments of new Gaussians are zero.

    The state is donated, the counters of `host` change. `on_message` is told of the first Gaussians
    that found no slot.

    Raises:
        UserError: no Gaussian is left.
    """
    key = compiled_key(device_seed(cfg.train.seed), np.int32(host.step))
    pause, reset_at = interval(cfg.densify, host), host.reset_at
    now = Moment(key, state.opt_state.gaussians, extent, pause, limit, host)
    outcome = strategy.densify(state.params.gaussians, state.population, now)
    refused = int(outcome.refused)
    if refused > 0:
        if host.refused == 0:
            on_message(
                f"Step {host.step}: {refused} Gaussians wanted to grow but the limit is "
                "reached; raise --densify.max-gaussians to let them. Counted from here on."
            )
        host.refused += refused
    state = grow_state(state, outcome.gaussians.capacity)
    opt_state = _zero_moments(state.opt_state, outcome.reset_moments)
    if host.reset_at != reset_at:
        opt_state = zero_opacity_moments(opt_state)
    params = dataclasses.replace(state.params, gaussians=outcome.gaussians)
    state = FitState(params, opt_state, outcome.population, state.step, state.fault)
    if alive_in(state.population) == 0:
        fix = "lower --densify.prune-opacity or raise --densify.prune-scale"
        raise UserError(f"Step {host.step}: densification removed every Gaussian.", fix=fix)
    return state
