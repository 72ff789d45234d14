"""The step of one view, divided over the cores of a CPU (docs/scaling.md, "Cores").

Each of N cores holds every N-th Gaussian; it lists, projects and moves those that the view may
show. The cores exchange splats, so that each knows all splats, and each composites every N-th row
of tiles; then they exchange the rows of the image (`render/cores.py`). A step still has one view.
Its result differs from a step on one core only by the order of sums and by the exploration noise:
every core draws other noise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from p2gs_jax.render.capacity import Capacity
from p2gs_jax.render.cores import CORES, gather, most, part, scatter_sum
from p2gs_jax.render.visible import whole_blocks
from p2gs_jax.train import image_gradient, update
from p2gs_jax.train.image_gradient import ImageGradient, Listed
from p2gs_jax.train.optimizer import OptState
from p2gs_jax.train.state import FitState, grow_state
from p2gs_jax.train.step import MeshStep
from p2gs_jax.types import Params

ALIKE: Any = P()
DIVIDED: Any = P(CORES)
# Capacity of a core as multiples of its equal share: of Gaussians in view, of tile-list entries.
SPARE, SPARE_ENTRIES = 1.05, 1.25


def _show(gaussians, alive, frustum, active_degree, owner, **static) -> Listed:
    listed = image_gradient.show(gaussians, alive, frustum, active_degree, owner, **static)
    return listed._replace(visible=listed.visible[None])


def _differentiate(shown, photometry, appearance, batch, partner, **static) -> ImageGradient:
    whole = (gather(shown), photometry, appearance, batch, partner)
    gradient = image_gradient.differentiate(*whole, **static)
    return gradient._replace(
        v_shown=scatter_sum(gradient.v_shown),
        visible=part(gradient.visible),
        entries=most(gradient.entries),
        overflow=most(gradient.overflow.astype(jnp.int32)) > 0,
    )


def _advance(state, ids, visible, gradient, frustum, controls, **static):
    full = most((visible[0] > ids.shape[0]).astype(jnp.int32)) > 0
    gradient = gradient._replace(overflow=gradient.overflow | full)
    return update.advance(state, ids, visible[0], gradient, frustum, controls, **static)


LISTED = Listed(*(DIVIDED for _ in Listed._fields))
GRADIENT = ImageGradient(*(ALIKE for _ in ImageGradient._fields))
GRADIENT = GRADIENT._replace(v_shown=DIVIDED, visible=DIVIDED)
STATE = FitState(
    params=Params(DIVIDED, ALIKE, ALIKE),
    opt_state=OptState(DIVIDED, ALIKE),
    population=DIVIDED,
    step=ALIKE,
    fault=ALIKE,
)


def mesh_of_cores() -> Mesh | None:
    """Return the mesh of CPU cores (`core.runtime.use_cores`); None on a GPU or a single core."""
    if jax.default_backend() != "cpu" or jax.device_count() == 1:
        return None
    return Mesh(np.array(jax.devices()), (CORES,))


@dataclasses.dataclass(frozen=True, eq=False)
class DividedStep(MeshStep):
    """The step of one view over the cores of a mesh; core k has the slots k, k + N, ..."""

    programs: ClassVar = {
        "show": (_show, (DIVIDED, DIVIDED, ALIKE, ALIKE, DIVIDED), LISTED),
        "differentiate": (_differentiate, (DIVIDED, ALIKE, ALIKE, ALIKE, ALIKE), GRADIENT),
        "advance": (_advance, (STATE, DIVIDED, DIVIDED, GRADIENT, ALIKE, ALIKE), (STATE, ALIKE)),
    }

    def program(self, name: str, capacity: Capacity, degree: int) -> Any:
        """Return one of the three programs, for a core's share of the capacity."""
        count = self.mesh.size
        visible = whole_blocks(int(SPARE * capacity.visible / count))
        of_core = Capacity(int(SPARE_ENTRIES * capacity.entries / count), visible)
        return super().program(name, of_core, degree)

    def slots(self, count: int) -> int:
        """Return the smallest multiple of the number of cores that is at least `count`."""
        return -(-count // self.mesh.size) * self.mesh.size

    def spread(self, state: FitState) -> FitState:
        """Return the state divided over the cores."""
        state = grow_state(state, self.slots(state.params.gaussians.capacity))

        def put(a, spec):
            a = _dealt(a, self.mesh.size) if spec == DIVIDED else a
            return jax.device_put(a, NamedSharding(self.mesh, spec))

        return _placed(put, jax.device_get(state))

    def whole(self, state: FitState) -> FitState:
        """Return the state on the default device, with slots in their original order."""

        def put(a, spec):
            return jnp.asarray(_dealt(a, len(a) // self.mesh.size) if spec == DIVIDED else a)

        return _placed(put, jax.device_get(state))


def _dealt(a: np.ndarray, count: int) -> np.ndarray:
    """Return rows 0, count, 2 count, ... of an array, then rows 1, count + 1, ..., and so on."""
    return a.reshape(-1, count, *a.shape[1:]).swapaxes(0, 1).reshape(a.shape)


def _placed(put: Callable, state: FitState) -> FitState:
    """Return the state after `put(array, specification)` for every array, by STATE."""

    def tree(spec, part):
        return jax.tree.map(lambda a: put(a, spec), part)

    return jax.tree.map(tree, STATE, state, is_leaf=lambda spec: isinstance(spec, P))
