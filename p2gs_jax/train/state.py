"""The state of a fit: the arrays that a step changes, and the counters that the host keeps.

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
from p2gs_jax.render.capacity import Capacity
from p2gs_jax.train.optimizer import Optimizer, OptState, grow_moments
from p2gs_jax.types import Array, Params, Population

FAULT_NONE, FAULT_OVERFLOW, FAULT_NONFINITE = 0, 1, 2


class Fault(eqx.Module):
    """The reason why no step writes; it stays set, so the host need not look after every step."""

    kind: Int[Array, ""]  # 0 none, 1 a list was too short, 2 a value is not finite
    needed: Int[Array, ""]  # entries that the tile list needed
    visible: Int[Array, ""]  # Gaussians that the view may show
    term: Int[Array, ""]  # index in `finite_names` of the first value that is not finite

    @classmethod
    def none(cls) -> Fault:
        """Return the record of a state without a fault."""
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
    """The counters that the host keeps between bursts; every checkpoint holds them."""

    step: int = 0  # views completed
    planned: float = 0.0  # length of the run: steps, or seconds of its time budget
    progress: float = 0.0  # fraction of the run completed
    pace: float = 0.0  # progress per view
    elapsed_s: float = 0.0  # seconds of this session and of earlier ones
    densified_at: float = 0.0  # progress of the last densification
    reset_at: float = 0.0  # progress of the last opacity reset
    refused: int = 0  # requests for new Gaussians without a free slot, summed over the run
    overflows: int = 0  # how many times a capacity grew
    # capacity of a view for every image size "WxH"; checkpoints hold it by this name
    rooms: dict[str, Capacity] = field(default_factory=dict)
    shrink: int = 0  # factor by which the present level shrinks images
    # running mean of the seconds per view at this level, without compilation; 0: not timed yet
    step_s: float = 0.0

    @classmethod
    def from_dict(cls, values: dict) -> HostState:
        """Return the counters from the dictionary that a checkpoint holds."""
        return cls(**{**values, "rooms": {k: Capacity(*c) for k, c in values["rooms"].items()}})

    def extended(self, planned: float) -> HostState:
        """Return the counters for a longer plan (`planned`: steps or seconds); progress shrinks."""
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
    """Return the state before the first step, with at least `slots` slots for Gaussians.

    `alive` flags the rows of `params` that exist; `owner` is the moving object of each row.
    """
    # A step donates its state. The result is a copy, so the caller keeps `params`.
    return jax.tree.map(jnp.asarray, _initial_state(params, alive, optimizer, slots, owner))


@functools.partial(jax.jit, static_argnames=("optimizer", "slots"))
def _initial_state(params: Params, alive, optimizer: Optimizer, slots: int, owner) -> FitState:
    population = fresh_population(alive, owner)
    state = FitState(params, optimizer.init(params), population, jnp.int32(0), Fault.none())
    return grow_state(state, slots)


def alive_in(population: Population) -> int:
    """Return the number of living Gaussians, read from the device."""
    return int(_sum(population.alive))


_sum = jax.jit(jnp.sum)


def grow_state(state: FitState, capacity: int) -> FitState:
    """Return the state with at least `capacity` slots for Gaussians; new slots are empty."""
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
    """Return the shapes that the state would have with `capacity` slots for Gaussians."""

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
    """Return the state without its fault; the arrays stay on their devices."""
    return dataclasses.replace(state, fault=jax.tree.map(jnp.zeros_like, state.fault))
