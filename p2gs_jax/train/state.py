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
import numpy as np
from jaxtyping import Bool, Int

from p2gs_jax.gaussians.population import empty_gaussians, empty_population, fresh_population, grow
from p2gs_jax.render.capacity import Room
from p2gs_jax.train.optimizer import Optimizer, OptState, grow_moments
from p2gs_jax.types import Array, Params, Population

FAULT_NONE, FAULT_OVERFLOW, FAULT_NONFINITE = 0, 1, 2


class Fault(eqx.Module):
    """Why the state stopped advancing; sticky, so the host need not look after every step."""

    kind: Int[Array, ""]  # 0 none, 1 a view needs more room, 2 something is not finite
    needed: Int[Array, ""]  # entries that the tile list needed
    visible: Int[Array, ""]  # Gaussians that the view showed
    term: Int[Array, ""]  # index into the names of loss terms and gradients that was not finite

    @classmethod
    def none(cls) -> Fault:
        """Return the state of health."""
        return cls(*(jnp.int32(0) for _ in range(4)))


class FitState(eqx.Module):
    """Everything that a step reads and writes; `step` counts views."""

    params: Params
    opt_state: OptState
    population: Population
    step: Int[Array, ""]
    fault: Fault


@dataclass
class HostState:
    """What the host remembers between bursts; saved with every checkpoint."""

    step: int = 0  # steps completed, a view each
    planned: float = (
        0.0  # steps of the run, or seconds of its budget: what `progress` is a share of
    )
    progress: float = 0.0  # fraction of the run completed
    pace: float = 0.0  # progress per step
    elapsed_s: float = 0.0  # seconds of earlier sessions and of this one
    densified_at: float = 0.0  # progress of the last densification
    reset_at: float = 0.0  # progress of the last opacity reset
    refused: int = 0  # densification requests that found no slot, summed
    overflows: int = 0  # tile lists grown
    rooms: dict[str, Room] = field(default_factory=dict)  # room of a view for every "WxH"
    shrink: int = 0  # factor by which images are shrunk at the present level
    # running estimate of the seconds a step takes at this level, compiling apart; 0: none was timed
    # yet
    step_s: float = 0.0

    @classmethod
    def from_dict(cls, values: dict) -> HostState:
        """Return what a checkpoint holds."""
        return cls(**{**values, "rooms": {k: Room(*room) for k, room in values["rooms"].items()}})

    def extended(self, planned: float) -> HostState:
        """Return the counters of the same run planned longer: less of it is completed."""
        share = self.planned / planned
        times = {
            k: share * getattr(self, k) for k in ("progress", "pace", "densified_at", "reset_at")
        }
        return dataclasses.replace(self, planned=planned, **times)


def initial_state(
    params: Params,
    alive: Bool[Array, " n"] | Bool[np.ndarray, " n"],
    optimizer: Optimizer,
    slots: int = 0,
    owner: Int[Array, " n"] | Int[np.ndarray, " n"] | None = None,
) -> FitState:
    """Return the state before the first step, with room for `slots` Gaussians at least.

    `alive` says which of `params` exist, `owner` which moving object each belongs to.
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


def shapes_of(state: FitState, capacity: int) -> FitState:
    """Return the shapes of the state if it had room for `capacity` Gaussians."""

    def shapes(tree, rows: tuple[int, ...] = ()):
        return jax.tree.map(
            lambda a: jax.ShapeDtypeStruct(rows + a.shape[len(rows) :], a.dtype), tree
        )

    of_slots = (state.params.gaussians, state.opt_state.gaussians, state.population)
    gaussians, moments, population = shapes(of_slots, (capacity,))
    rest = shapes(state)
    return dataclasses.replace(
        rest,
        params=dataclasses.replace(rest.params, gaussians=gaussians),
        opt_state=rest.opt_state._replace(gaussians=moments),
        population=population,
    )


def healed(state: FitState) -> FitState:
    """Return the state without its fault, which lies where it lay."""
    return dataclasses.replace(state, fault=jax.tree.map(jnp.zeros_like, state.fault))
