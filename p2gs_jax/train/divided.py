"""The step of one view, divided over the cores of a CPU (docs/scaling.md, "Cores").

Each core holds every N-th Gaussian, lists and projects those of them that the view may show, and
moves them. All cores then know all splats, composite every N-th row of tiles, and know the whole
image; `render/cores.py` says what is divided there. One view a step stays one view a step: the
result is that of one core up to the order of sums, and of exploration noise, which every core draws
for its Gaussians.
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

from p2gs_jax.render.capacity import Room
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
# Room of a core over its fair share of a view's Gaussians, and of its entries.
SPARE, SPARE_ENTRIES = 1.05, 1.25


def _show(gaussians, alive, frustum, active_degree, owner, **given) -> Listed:
    listed = image_gradient.show(gaussians, alive, frustum, active_degree, owner, **given)
    return listed._replace(visible=listed.visible[None])


def _differentiate(shown, photometry, appearance, batch, partner, **given) -> ImageGradient:
    whole = (gather(shown), photometry, appearance, batch, partner)
    gradient = image_gradient.differentiate(*whole, **given)
    return gradient._replace(
        v_shown=scatter_sum(gradient.v_shown),
        visible=part(gradient.visible),
        entries=most(gradient.entries),
        overflow=most(gradient.overflow.astype(jnp.int32)) > 0,
    )


def _advance(state, ids, visible, gradient, frustum, controls, **given):
    full = most((visible[0] > ids.shape[0]).astype(jnp.int32)) > 0
    gradient = gradient._replace(overflow=gradient.overflow | full)
    return update.advance(state, ids, visible[0], gradient, frustum, controls, **given)


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
    """Return the cores that a fit divides a view over; None for one (`core.runtime.use_cores`)."""
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

    def program(self, name: str, room: Room, degree: int) -> Any:
        """Return one of the three programs, for a core's share of the room."""
        count = self.mesh.size
        visible = whole_blocks(int(SPARE * room.visible / count))
        mine = Room(int(SPARE_ENTRIES * room.entries / count), visible)
        return super().program(name, mine, degree)

    def slots(self, count: int) -> int:
        """Return as many slots as give every core the same number."""
        return -(-count // self.mesh.size) * self.mesh.size

    def spread(self, state: FitState) -> FitState:
        """Return a state divided over the cores."""
        state = grow_state(state, self.slots(state.params.gaussians.capacity))

        def put(a, spec):
            a = _dealt(a, self.mesh.size) if spec == DIVIDED else a
            return jax.device_put(a, NamedSharding(self.mesh, spec))

        return _placed(put, jax.device_get(state))

    def whole(self, state: FitState) -> FitState:
        """Return a state on the default device, its slots in order."""

        def put(a, spec):
            return jnp.asarray(_dealt(a, len(a) // self.mesh.size) if spec == DIVIDED else a)

        return _placed(put, jax.device_get(state))


def _dealt(a: np.ndarray, count: int) -> np.ndarray:
    """Return rows 0, count, 2 count, ... of an array, then rows 1, count + 1, ..., and so on."""
    return a.reshape(-1, count, *a.shape[1:]).swapaxes(0, 1).reshape(a.shape)


def _placed(put: Callable, state: FitState) -> FitState:
    """Return a state of which every array was put where its specification says."""

    def tree(spec, part):
        return jax.tree.map(lambda a: put(a, spec), part)

    return jax.tree.map(tree, STATE, state, is_leaf=lambda spec: isinstance(spec, P))
