"""Densification: when the population changes, and how (gsplat calls this a strategy).

A strategy is any object with the methods of `Strategy`; pass a custom one to `make_step` or `fit`.
`DensifyConfig` sets the period and the interval of densification. The functions that add and remove
Gaussians are pure: they map Gaussians and population to an `Outcome`.
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
    empty_gaussians,
    empty_population,
    grow,
    seed_bound,
)
from p2gs_jax.train.optimizer import AdamState, zero_moments, zero_opacity_moments
from p2gs_jax.train.schedule import Levels, shrinks_left
from p2gs_jax.train.state import FitState, HostState, alive_in, grow_state
from p2gs_jax.types import Array, Gaussians, Population

SLOTS = 1024  # numbers of slots are multiples of this
# A step at full size takes about twice as long as a step at the coarse level before.
FULL_SIZE_COST = 2.0


class Slots(NamedTuple):
    """The bound on the population, and its number of slots at the start."""

    limit: int | None  # bound on the population; None: no bound
    slots: int  # slots at the start

    @property
    def most(self) -> int:
        """The largest population for which capacities are allocated."""
        return max(self.limit or 0, self.slots)


class Event(NamedTuple):
    """One densification: its inputs besides Gaussians and population."""

    key: PRNGKeyArray  # random key of this densification
    moments: AdamState  # Adam's moments of the Gaussians
    extent: float  # scene extent, scene units
    interval: float  # progress between two densifications
    limit: int | None  # bound on the population, or None
    # counters of the run; a strategy that resets opacities sets `reset_at`
    host: HostState


@runtime_checkable
class Strategy(Protocol):
    """A rule that adds and removes Gaussians.

    Two attributes are optional. `noise` is the scale of the exploration noise that steps add to the
    means; with None (default), `Population` sums screen-space gradients instead. `slots_stay`
    (default: True) means that the number of slots never changes, so that steps can be compiled
    ahead.
    """

    def start(self, seeds: int) -> int | Slots:
        """Return the number of slots at the start, at least the number of seeds."""
        ...

    def densify(self, gaussians: Gaussians, population: Population, now: Event) -> Outcome:
        """Return the new population, with at least as many slots.

        Moments of the slots in `Outcome.reset_moments` become zero. A strategy that returns
        `fresh_population` resets the statistics, too.
        """
        ...


def demand(gaussians: Gaussians, moments: AdamState, b2: float) -> Float[Array, " n"]:
    """Return the demand for more Gaussians at each Gaussian; 0 for those that no step has seen.

    Demand is the root mean square, over the views that showed a Gaussian, of the loss's gradient
    by its mean, in units of its largest scale. If views pull a Gaussian in different directions,
    one Gaussian is too few. 3DGS splits by the mean length of the same gradient on the screen
    (ours: BUILD_NOTES, "Births where they are needed"). `b2` is Adam's decay of the second moment.
    """
    square = jnp.sum(moments.nu.means, -1)
    share = 1 - b2 ** moments.counts.astype(jnp.float32)
    seen = moments.counts > 0
    mean_square = jnp.where(seen, square / jnp.where(seen, share, 1.0), 0.0)
    value = jnp.sqrt(mean_square) * jnp.exp(jnp.max(gaussians.log_scales, -1))
    return jnp.where(jnp.isfinite(value), value, 0.0)


@functools.partial(jax.jit, static_argnames=("cfg", "b2"))
def relocate(key, gaussians, population, moments, births, *, cfg: DensifyConfig, b2: float):
    """Relocate, and add `births` Gaussians by their `demand` (`mcmc.relocate_and_grow`)."""
    weight = demand(gaussians, moments, b2)
    return mcmc.relocate_and_grow(key, gaussians, population, births, cfg, weight)


class Mcmc:
    """`densify.method` mcmc: Kheradmand et al. 2024, with births chosen by `demand` (ours).

    It relocates transparent Gaussians, and grows the population by a factor up to a bound.
    """

    slots_stay = True

    def __init__(self, cfg: FitConfig, coverage: Coverage, levels: Levels):
        self.cfg, self.coverage, self.levels = cfg, coverage, levels
        self.noise = cfg.densify.noise
        self._static = {"cfg": cfg.densify, "b2": cfg.optimizer.b2}
        self._relocate: Callable[..., Outcome] = functools.partial(relocate, **self._static)

    def start(self, seeds: int) -> Slots:
        """Return the bound, configured or chosen from the scene, and as many slots."""
        limit = max(seed_bound(self.cfg, seeds, self.coverage), seeds)
        # Rounded up, so that a late change in the number of seeds needs no other program.
        return Slots(limit, -(-limit // SLOTS) * SLOTS)

    def expect(self, programs: Any, state: FitState) -> None:
        """Begin to compile the relocation for these shapes; `programs` is a `StepPrograms`."""
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

    def densify(self, gaussians: Gaussians, population: Population, now: Event) -> Outcome:
        """Relocate, and grow towards the bound."""
        alive = alive_in(population)
        births = np.int32(max(self._target(alive, now) - alive, 0))
        return self._relocate(now.key, gaussians, population, now.moments, births)

    def _target(self, alive: int, now: Event) -> int:
        """Return the population after the next relocation."""
        limit = self._affordable(alive, now)
        growth_left = max((limit or alive) / max(alive, 1), 1.0)
        # The last event reaches the limit: Gaussians born earlier would cost time in more steps.
        events = (self.cfg.densify.stop - now.host.progress) / now.interval
        factor = growth_left ** (1 / max(events, 1.0))
        return min(math.ceil(alive * factor), limit or alive)

    def _affordable(self, alive: int, now: Event) -> int | None:
        """Return the bound on the population that the speed of this machine allows.

        A bound chosen for a time budget assumes an unloaded machine; this checks it again.
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

    This is the paper's method. The number of slots grows with the population.
    """

    noise = None
    slots_stay = False

    def __init__(self, cfg: FitConfig):
        self.cfg = cfg.densify

    def start(self, seeds: int) -> Slots:
        """Return the configured bound, and a slot per seed."""
        return Slots(self.cfg.max_gaussians, seeds)

    def densify(self, gaussians: Gaussians, population: Population, now: Event) -> Outcome:
        """Prune, clone and split; reset opacities if a reset is due."""
        d, host = self.cfg, now.host
        proposal = _propose(gaussians, population, now.extent, host.reset_at > 0, cfg=d)
        before = gaussians.capacity
        capacity = bucket_for(int(proposal.wanted), before)
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
    """Return the strategy of `DensifyConfig`; with None the population never changes."""
    if cfg.densify.method == "mcmc":
        return Mcmc(cfg, coverage, levels)
    return None if cfg.densify.method is None else Adaptive(cfg)


def started(strategy: Strategy | None, seeds: int) -> Slots:
    """Return the bound and slots of a strategy, whose `start` may return a number only."""
    found = Slots(None, seeds) if strategy is None else strategy.start(seeds)
    return found if isinstance(found, Slots) else Slots(found, found)


def interval(d: DensifyConfig, host: HostState) -> float:
    """Return the progress between two densifications."""
    return max(d.every, d.min_every_steps * host.pace)


def is_due(d: DensifyConfig, host: HostState) -> bool:
    """Return whether a densification is due."""
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

    The state is donated, and the counters of `host` change. `on_message` reports the first time
    that Gaussians find no free slot. Raises UserError: no Gaussian is left.
    """
    key = compiled_key(device_seed(cfg.train.seed), np.int32(host.step))
    pause, reset_at = interval(cfg.densify, host), host.reset_at
    now = Event(key, state.opt_state.gaussians, extent, pause, limit, host)
    outcome = strategy.densify(state.params.gaussians, state.population, now)
    refused = int(outcome.refused)
    if refused > 0:
        if host.refused == 0:
            on_message(
                f"Step {host.step}: {refused} Gaussians could not grow because the limit is "
                "reached; raise --densify.max-gaussians. Later ones are only counted."
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
