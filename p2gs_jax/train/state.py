"""The state of a fit: what a step maps to its successor, and what the host remembers beside it.

A checkpoint holds both.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from p2gs_jax.gaussians.population import empty_gaussians, empty_population, fresh_population, grow
from p2gs_jax.render.capacity import Room
from p2gs_jax.train.optimizer import Optimizer, OptState, grow_moments
from p2gs_jax.types import Gaussians, Params, Population

FAULT_NONE, FAULT_OVERFLOW, FAULT_NONFINITE = 0, 1, 2


class Fault(eqx.Module):
    """Why the state stopped advancing; sticky, so the host need not look after every step.

    Attributes:
        kind: 0 none, 1 a view needs more room, 2 something is not finite.
        needed: entries that the tile list needed.
        visible: Gaussians that the view showed.
        term: index into the names of loss terms and gradients that was not finite.
    """

    kind: Int[Array, ""]
    needed: Int[Array, ""]
    visible: Int[Array, ""]
    term: Int[Array, ""]

    @classmethod
    def none(cls) -> Fault:
        """Return the state of health."""
        return cls(*(jnp.int32(0) for _ in range(4)))


class FitState(eqx.Module):
    """Everything that a step reads and writes.

    Attributes:
        params: the differentiable pytree.
        opt_state: the optimiser's.
        population: who is alive.
        step: steps completed, a view each.
        fault: while it is set, steps leave the state as it is.
    """

    params: Params
    opt_state: OptState
    population: Population
    step: Int[Array, ""]
    fault: Fault


@dataclass
class HostState:
    """What the host remembers between bursts; saved with every checkpoint.

    Attributes:
        step: steps completed, a view each.
        progress: fraction of the run completed.
        pace: progress per step.
        elapsed_s: seconds of earlier sessions and of this one.
        densified_at: progress of the last densification.
        reset_at: progress of the last opacity reset.
        refused: densification requests that found no slot, summed.
        overflows: tile lists grown.
        rooms: room of a view for every "WxH".
        shrink: factor by which images are shrunk at the present level.
        step_s: running estimate of the seconds a step takes at this level, compiling apart; 0:
            none was timed yet.
    """

    step: int = 0
    progress: float = 0.0
    pace: float = 0.0
    elapsed_s: float = 0.0
    densified_at: float = 0.0
    reset_at: float = 0.0
    refused: int = 0
    overflows: int = 0
    rooms: dict[str, Room] = field(default_factory=dict)
    shrink: int = 0
    step_s: float = 0.0

    @classmethod
    def from_dict(cls, values: dict) -> HostState:
        """Return what a checkpoint holds."""
        return cls(**{**values, "rooms": {k: Room(*room) for k, room in values["rooms"].items()}})


def initial_state(
    params: Params,
    alive: Array,
    optimizer: Optimizer,
    slots: int = 0,
    owner: Int[Array, " n"] | None = None,
) -> FitState:
    """Return the state before the first step.

    Args:
        params: the start.
        alive: which Gaussians exist.
        optimizer: from `make_optimizer`.
        slots: room of the population, at least what `params` holds.
        owner: the moving object that each Gaussian belongs to, or None.
    """
    # The step donates its state: the caller keeps its parameters.
    return jax.tree.map(jnp.asarray, _initial_state(params, alive, optimizer, slots, owner))


@functools.partial(jax.jit, static_argnames=("optimizer", "slots"))
def _initial_state(params: Params, alive, optimizer: Optimizer, slots: int, owner) -> FitState:
    population = fresh_population(alive, owner)
    state = FitState(params, optimizer.init(params), population, jnp.int32(0), Fault.none())
    return grow_state(state, slots)


def alive_in(population: Population) -> int:
    """Return how many Gaussians are alive, read from the device."""
    return int(_sum(population.alive))


_sum = jax.jit(jnp.sum)


def grow_state(state: FitState, capacity: int) -> FitState:
    """Return the state with room for `capacity` Gaussians; the new slots are empty."""
    gaussians = state.params.gaussians
    extra = capacity - gaussians.capacity
    if extra <= 0:
        return state
    empty = empty_gaussians(extra, gaussians)
    return dataclasses.replace(
        state,
        params=dataclasses.replace(state.params, gaussians=grow(gaussians, empty)),
        opt_state=grow_moments(state.opt_state, empty),
        population=grow(state.population, empty_population(extra, state.population)),
    )


def replace_gaussians(
    state: FitState, gaussians: Gaussians, population: Population, opt_state: OptState
) -> FitState:
    """Return the state with another population."""
    return dataclasses.replace(
        state,
        params=dataclasses.replace(state.params, gaussians=gaussians),
        population=population,
        opt_state=opt_state,
    )
