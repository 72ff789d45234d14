"""A step of several views on a mesh of devices: three programs, as that of one view."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from p2gs_jax.config import FitConfig
from p2gs_jax.core.devices import AXES, GAUSSIANS, VIEWS
from p2gs_jax.losses.total import Partner
from p2gs_jax.render.capacity import Room
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.advance import StepReport
from p2gs_jax.train.image_gradient import ImageGradient
from p2gs_jax.train.mesh import parts
from p2gs_jax.train.mesh.parts import ListedViews
from p2gs_jax.train.mesh.spread import placed, specs_of
from p2gs_jax.train.optimizer import Optimizer
from p2gs_jax.train.state import FitState
from p2gs_jax.train.step import Step
from p2gs_jax.types import Batch, Frustum

EVERYWHERE, OF_GAUSSIANS, OF_GROUP = P(), P(GAUSSIANS), P(VIEWS)
# Views of the devices, and what each device has of the views of its group.
OF_DEVICE, OF_BOTH = P(AXES), P(VIEWS, GAUSSIANS)

# Where the results lie; records annotate arrays.
LISTED: Any = cast(Any, ListedViews)(ids=OF_BOTH, visible=OF_BOTH, shown=OF_DEVICE)
GRADIENT: Any = cast(Any, ImageGradient)(
    **{name: EVERYWHERE for name in ImageGradient._fields}
    | {"v_shown": OF_DEVICE, "visible": OF_DEVICE}
)
REPORT: Any = cast(Any, StepReport)(*[EVERYWHERE] * len(StepReport._fields))


@dataclasses.dataclass(frozen=True, eq=False)
class MeshStep:
    """The step `(state, batch, partner, controls, ...)` of `train/step.py`, of several views.

    Batches and partners come stacked (`batches.stacked`), states spread (`OnMesh`).

    Attributes:
        cfg: everything; `train.batch` is a multiple of the devices.
        optimizer: from `make_optimizer`.
        extent: scene extent, scene units.
        mesh: (views, Gaussians).
    """

    cfg: FitConfig
    optimizer: Optimizer
    extent: float
    mesh: Mesh

    @functools.cached_property
    def _single(self) -> Step:
        """The step of one view, which knows what the parts take from the configuration."""
        return Step(self.cfg, self.optimizer, self.extent)

    def settings(self, name: str) -> dict[str, Any]:
        """Return what one of the three programs takes from the configuration, by argument."""
        divided = {"parts": self.mesh.shape[GAUSSIANS], "views": self.cfg.train.batch}
        wanted = {"show": ("parts",), "differentiate": ("views",)}.get(name, tuple(divided))
        return self._single.settings(name) | {k: divided[k] for k in wanted} | {"mesh": self.mesh}

    def chained(self, show, differentiate, advance):
        """Return the step made of its three programs, compiled or not."""

        def step(state: FitState, batch, partner, controls):
            frusta = self._frusta(batch, partner)
            inputs = {
                "batch": (batch, OF_DEVICE),
                "partner": (partner, OF_DEVICE),
                "frusta": (frusta, OF_GROUP),
                "controls": (controls, EVERYWHERE),
            }
            given = {k: self._placed(tree, spec) for k, (tree, spec) in inputs.items()}
            params, population = state.params, state.population
            listed = show(
                params.gaussians,
                population.alive,
                given["frusta"],
                given["controls"].active_degree,
                population.owner,
            )
            gradient = differentiate(
                listed.shown, params.photometry, params.appearance, given["batch"], given["partner"]
            )
            return advance(
                state, listed.ids, listed.visible, gradient, given["frusta"], given["controls"]
            )

        return step

    def lowered(
        self, name: str, state: FitState, batch, partner, controls, *, room: Room, degree: int
    ):
        """Return one of the three programs, by its name, traced for arguments of these shapes."""
        frusta = jax.eval_shape(self._frusta, batch, partner)
        sizes = {
            "show": {"room": room.visible, "degree": degree},
            "differentiate": {"room": room.entries},
            "advance": {"degree": degree},
        }

        def program(part: str):
            static = self.settings(part) | sizes[part]
            return _compiled(part, **static)

        state = self._shapes(state, specs_of(state))
        frusta = self._shapes(frusta, OF_GROUP)
        controls = self._shapes(controls, EVERYWHERE)
        batch, partner = (self._shapes(a, OF_DEVICE) for a in (batch, partner))
        params, population = state.params, state.population
        arguments = (params.gaussians, population.alive, frusta, controls.active_degree)
        arguments = (*arguments, population.owner)
        if name == "show":
            return program(name).lower(*arguments)
        listed = program("show").eval_shape(*arguments)
        listed = ListedViews(*(self._shapes(a, s) for a, s in zip(listed, LISTED, strict=True)))
        image = (listed.shown, params.photometry, params.appearance, batch, partner)
        if name == "differentiate":
            return program(name).lower(*image)
        found = program("differentiate").eval_shape(*image)
        gradient = (self._shapes(a, s) for a, s in zip(found, GRADIENT, strict=True))
        moved = (state, listed.ids, listed.visible, ImageGradient(*gradient), frusta, controls)
        return program(name).lower(*moved)

    def _frusta(self, batch: Batch, partner: Partner) -> tuple[Frustum, ...]:
        """Return the views of a step, stacked."""
        every = (self.cfg.train.batch,)
        return tuple(
            dataclasses.replace(
                frustum,
                width=np.full(every, frustum.width, np.float32),
                height=np.full(every, frustum.height, np.float32),
            )
            for frustum in self._single.frusta(batch, partner)
        )

    def _placed(self, tree, spec: P):
        return jax.tree.map(lambda a: placed(a, self.mesh, spec), tree)

    def _shapes(self, tree, specs):
        """Return shapes with where their arrays lie; `specs` is of one tree, or for all of it."""
        if isinstance(specs, P):
            specs = jax.tree.map(lambda _: specs, tree)
        return jax.tree.map(
            lambda a, spec: jax.ShapeDtypeStruct(
                a.shape, a.dtype, sharding=NamedSharding(self.mesh, spec)
            ),
            tree,
            specs,
        )


@functools.cache
def _compiled(name: str, *, mesh: Mesh, **static: Any) -> Any:
    """Return a part of a step, divided over the mesh and jitted."""
    body: Callable = functools.partial(getattr(parts, name), **static)

    def program(*arguments):
        into, out = _specs(name, arguments)
        return jax.shard_map(body, mesh=mesh, in_specs=into, out_specs=out, check_vma=False)(
            *arguments
        )

    donated = (0,) if name == "advance" else ()
    return jax.jit(program, compiler_options=compiler_options(), donate_argnums=donated)


def _specs(name: str, arguments) -> tuple[Any, Any]:
    """Return along which axes the arguments and the results of a part are divided."""
    if name == "show":
        return (OF_GAUSSIANS, OF_GAUSSIANS, OF_GROUP, EVERYWHERE, OF_GAUSSIANS), LISTED
    if name == "differentiate":
        return (OF_DEVICE, EVERYWHERE, EVERYWHERE, OF_DEVICE, OF_DEVICE), GRADIENT
    state = specs_of(arguments[0])
    into = (state, OF_BOTH, OF_BOTH, GRADIENT, OF_GROUP, EVERYWHERE)
    return into, (state, REPORT)
