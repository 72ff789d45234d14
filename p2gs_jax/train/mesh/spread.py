"""The state of a fit on a mesh of devices, and as a whole."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from p2gs_jax.core.devices import GAUSSIANS
from p2gs_jax.train.state import Fault, FitState, grow_state


class Spread(Protocol):
    """How a state lies on the devices of a fit."""

    def padded(self, slots: int) -> int:
        """Return the room for a population, at least `slots`."""
        ...

    def own(self, batch: int) -> tuple[int, ...]:
        """Return which views of a batch the devices of this process composite."""
        ...

    def spread(self, state: FitState) -> FitState:
        """Return a whole state as steps take it."""
        ...

    def whole(self, state: FitState) -> FitState:
        """Return a state of steps as a whole, for what looks at all Gaussians."""
        ...

    def healed(self, state: FitState) -> FitState:
        """Return a state of steps without its fault."""
        ...


class OnOneDevice:
    """Nothing is moved."""

    def padded(self, slots: int) -> int:
        """See `Spread`."""
        return slots

    def own(self, batch: int) -> tuple[int, ...]:
        """See `Spread`."""
        return tuple(range(batch))

    def spread(self, state: FitState) -> FitState:
        """See `Spread`."""
        return state

    def whole(self, state: FitState) -> FitState:
        """See `Spread`."""
        return state

    def healed(self, state: FitState) -> FitState:
        """See `Spread`."""
        return dataclasses.replace(state, fault=Fault.none())


@dataclasses.dataclass(frozen=True)
class OnMesh:
    """Gaussians are dealt out along one axis of the mesh, everything else is everywhere.

    Slot i is row i // G of device i mod G: so devices have equally many live Gaussians, and
    each view shows about as many of each.

    Attributes:
        mesh: (views, Gaussians).
    """

    mesh: Mesh

    @property
    def parts(self) -> int:
        """Into how many parts Gaussians are divided."""
        return self.mesh.shape[GAUSSIANS]

    def padded(self, slots: int) -> int:
        """See `Spread`."""
        return -(-slots // self.parts) * self.parts

    def own(self, batch: int) -> tuple[int, ...]:
        """See `Spread`."""
        each = batch // self.mesh.size
        processes = [device.process_index for device in self.mesh.devices.flat]
        here = jax.process_index()
        return tuple(k for k in range(batch) if processes[k // each] == here)

    def spread(self, state: FitState) -> FitState:
        """See `Spread`."""
        slots = self.padded(state.params.gaussians.capacity)
        host = jax.tree.map(np.asarray, grow_state(state, slots))
        host = _of_gaussians(host, self._dealt)
        return jax.tree.map(self._placed, host, specs_of(host))

    def whole(self, state: FitState) -> FitState:
        """See `Spread`."""
        if jax.process_count() > 1:
            host = multihost_utils.process_allgather(state, tiled=True)
        else:
            host = jax.tree.map(np.asarray, state)
        return jax.tree.map(jnp.asarray, _of_gaussians(host, self._collected))

    def healed(self, state: FitState) -> FitState:
        """See `Spread`."""
        none = jax.tree.map(np.asarray, Fault.none())
        fault = jax.tree.map(lambda a: placed(a, self.mesh, P()), none)
        return dataclasses.replace(state, fault=fault)

    def _dealt(self, a: np.ndarray) -> np.ndarray:
        split = a.reshape(-1, self.parts, *a.shape[1:])
        return split.swapaxes(0, 1).reshape(a.shape)

    def _collected(self, a: np.ndarray) -> np.ndarray:
        split = a.reshape(self.parts, -1, *a.shape[1:])
        return split.swapaxes(0, 1).reshape(a.shape)

    def _placed(self, a: np.ndarray, spec: P) -> jax.Array:
        return placed(a, self.mesh, spec)


def placed(a: np.ndarray, mesh: Mesh, spec: P) -> jax.Array:
    """Return an array of the host on the devices, each process giving what its own hold."""
    return jax.make_array_from_callback(a.shape, NamedSharding(mesh, spec), lambda at: a[at])


def specs_of(state: FitState) -> FitState:
    """Return along which axes of the mesh each array of a state is divided."""
    everywhere = jax.tree.map(lambda _: P(), state)
    return _of_gaussians(everywhere, lambda _: P(GAUSSIANS))


def _of_gaussians(state: FitState, change) -> FitState:
    """Return a state with every array of Gaussians changed."""

    def of(s: FitState):
        return s.params.gaussians, s.opt_state.gaussians, s.population

    return eqx.tree_at(of, state, jax.tree.map(change, of(state), is_leaf=_is_spec))


def _is_spec(value) -> bool:
    return isinstance(value, P)
