"""One optimisation step: three pure jitted functions, one after the other, compiled ahead.

The first and the last program work per Gaussian and depend on no image size, so all levels of a
fit share them. The middle program depends neither on the population nor on the optimiser. With a
single program, every level would compile all of it (BUILD_NOTES, "A step is three programs").
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, ClassVar, NamedTuple

import jax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.threads import available_cores
from p2gs_jax.presets import narrowed
from p2gs_jax.render.capacity import Capacity
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.exposure_loss import Partner
from p2gs_jax.train.image_gradient import differentiate, show
from p2gs_jax.train.optimizer import Optimizer
from p2gs_jax.train.state import FitState
from p2gs_jax.train.terms import LossTerm, loss_terms
from p2gs_jax.train.update import Controls, StepReport, advance
from p2gs_jax.types import Batch, Frustum

# The options that each program reads; None: the whole group. Fits that differ in other options
# share the program, and a program that reads another option raises AttributeError.
FORMATION_OPTIONS = ("curve", "spline", "pivot", "clamp", "cameras", "appearance")
OPTIONS_READ: dict[str, dict[str, Any]] = {
    "show": {"render": None, "optimizer": ("visible_only",)},
    "differentiate": {
        "render": None,
        "photometry": FORMATION_OPTIONS,
        "loss": ("censored", "saturation", "near_depth"),
    },
    "advance": {
        "render": None,
        "optimizer": None,
        "photometry": ("model", "start", "white_balance"),
        "loss": {"regularizers": ("log_exposure_mean",)},
    },
}

# The first step waits for two programs of about equal size. XLA itself compiles on several cores:
# on two cores, two compilations at once take three times as long each (ours: BUILD_NOTES).
WORKERS = 1 if available_cores() <= 2 else 2


PROGRAMS: dict[str, Callable[..., Any]] = {
    "show": show,
    "differentiate": differentiate,
    "advance": advance,
}


@functools.cache
def compiled(name: str, **static: Any) -> Any:
    """Return a program of a step, jitted; equal static arguments give the same function."""
    # Created on first use, because the compiler options depend on the backend.
    body = functools.partial(PROGRAMS[name], **static)
    donated = (0,) if name == "advance" else ()
    return jax.jit(body, compiler_options=compiler_options(), donate_argnums=donated)


@functools.cache
def compiled_over(kind: type[MeshStep], name: str, *, mesh: Mesh, **static: Any) -> Any:
    """Return a jitted program of a step on the devices of a mesh; arguments may be host arrays."""
    body, in_specs, out_specs = kind.programs[name]
    on_each = functools.partial(body, **static)
    shardings = jax.tree.map(
        lambda spec: NamedSharding(mesh, spec),
        (in_specs, out_specs),
        is_leaf=lambda spec: isinstance(spec, P),
    )
    return jax.jit(
        jax.shard_map(on_each, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False),
        in_shardings=shardings[0],
        out_shardings=shardings[1],
        compiler_options=compiler_options(),
        donate_argnums=(0,) if name == "advance" else (),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """The step `(state, batch, partner, controls, capacity=..., degree=...)` of a fit.

    A call returns the next state and a report; the previous state is donated. Random numbers depend
    on the seed and the step number alone. `image_loss` is the loss. Work per Gaussian runs in
    blocks, and only for Gaussians that the view may show; all others do not change
    (`OptimizerConfig.visible_only`). `train/update.py` describes how a step treats overflows and
    values that are not finite.
    """

    cfg: FitConfig
    optimizer: Optimizer  # from `make_optimizer`
    extent: float  # scene extent, scene units
    noise: float | None = None  # scale of the exploration noise, or None (`strategies.Strategy`)
    # loss terms by name, added to the terms of `cfg` or replacing them (`loss_terms`)
    terms: Mapping[str, LossTerm | None] = dataclasses.field(default_factory=dict)
    _ready: dict[Any, Callable] = dataclasses.field(default_factory=dict, init=False)

    def __call__(
        self,
        state: FitState,
        batch: Batch,
        partner: Partner,
        controls: Controls,
        *,
        capacity: Capacity,
        degree: int,
    ) -> tuple[FitState, StepReport]:
        """Take a step, compiling it on first use."""
        if (capacity, degree) not in self._ready:
            parts = (self.program(name, capacity, degree) for name in PROGRAMS)
            self._ready[capacity, degree] = self.chained(*parts)
        return self._ready[capacity, degree](state, batch, partner, controls)

    def chained(self, show, differentiate, advance):
        """Return the step that calls its three programs, compiled or not."""

        def step(state: FitState, batch: Batch, partner: Partner, controls: Controls):
            params, frustum = state.params, self.frustum(batch)
            listed = show(*per_gaussian(state, frustum, controls))
            gradient = differentiate(
                listed.shown, params.photometry, params.appearance, batch, partner
            )
            return advance(state, listed.ids, listed.visible, gradient, frustum, controls)

        return step

    def settings(self, name: str) -> dict[str, Any]:
        """Return the static arguments of one of the three programs, from the configuration."""
        cfg = narrowed(self.cfg, OPTIONS_READ[name])
        if name == "show":
            return {"cfg": cfg}
        if name == "differentiate":
            full = dataclasses.replace(self.cfg, photometry=cfg.photometry)
            return {"cfg": cfg, "terms": tuple(loss_terms(full, self.terms).items())}
        return {"cfg": cfg, "optimizer": self.optimizer, "extent": self.extent, "noise": self.noise}

    def lowered(
        self, name: str, state, batch, partner, controls, *, capacity: Capacity, degree: int
    ):
        """Return the program of this name, lowered for arguments of these shapes."""
        program = functools.partial(self.program, capacity=capacity, degree=degree)
        frustum, params = jax.eval_shape(self.frustum, batch), state.params
        arguments = per_gaussian(state, frustum, controls)
        if name == "show":
            return program(name).lower(*arguments)
        listed = program("show").eval_shape(*arguments)
        image = (listed.shown, params.photometry, params.appearance, batch, partner)
        if name == "differentiate":
            return program(name).lower(*image)
        gradient = program("differentiate").eval_shape(*image)
        update = (state, listed.ids, listed.visible, gradient, frustum, controls)
        return program(name).lower(*update)

    # Steps on several devices override these methods: `divided.py`, `data_parallel.py`.

    def program(self, name: str, capacity: Capacity, degree: int) -> Any:
        """Return one of the three programs, jitted."""
        return compiled(name, **self.settings(name), **static_sizes(name, capacity, degree))

    def frustum(self, batch: Batch) -> Frustum:
        """Return the view of a step, for the programs that depend on no image size."""
        c = batch.camera
        width, height = map(c.K.dtype.type, (c.width, c.height))
        return on_host(Frustum, c.viewmat, c.K, width, height, c.objects)

    def slots(self, count: int) -> int:
        """Return the smallest allowed number of slots that is at least `count`."""
        return count

    def spread(self, state: FitState) -> FitState:
        """Return the state laid out on the devices as steps need it."""
        return state

    def whole(self, state: FitState) -> FitState:
        """Return the state on the default device, as densification and checkpoints need it."""
        return state


@dataclasses.dataclass(frozen=True, eq=False)
class MeshStep(Step):
    """A step whose programs are divided over the devices of a mesh."""

    # For each program: the function of one device, the specs of its arguments and of its results.
    programs: ClassVar[dict[str, tuple[Any, Any, Any]]]
    mesh: Mesh = dataclasses.field(kw_only=True)

    def settings(self, name: str) -> dict[str, Any]:
        """Return the static arguments of one of the three programs, and the mesh."""
        return super().settings(name) | {"mesh": self.mesh}

    def program(self, name: str, capacity: Capacity, degree: int) -> Any:
        """Return one of the three programs, divided over the mesh and jitted."""
        static = self.settings(name) | static_sizes(name, capacity, degree)
        return compiled_over(type(self), name, **static)


def static_sizes(name: str, capacity: Capacity, degree: int) -> dict[str, int]:
    """Return the static sizes of one of the three programs, by argument name."""
    if name == "show":
        return {"capacity": capacity.visible, "degree": degree}
    return {"capacity": capacity.entries} if name == "differentiate" else {"degree": degree}


def per_gaussian(state: FitState, frustum: Frustum, controls: Controls) -> tuple:
    """Return the arguments of `show`."""
    params, population = state.params, state.population
    return params.gaussians, population.alive, frustum, controls.active_degree, population.owner


# ----------------------------------------------------------------------- compiled ahead


class Key(NamedTuple):
    """The sizes and types for which a step is compiled."""

    size: tuple[int, int]  # image width and height, pixels
    slots: int  # of the population
    capacity: Capacity  # of a view
    degree: int  # highest spherical-harmonics degree in use
    pixels: str  # data type of the stored photograph
    structure: Hashable = None  # tree structure of the state and of the optional inputs of a view


class StepPrograms:
    """The compiled steps of a fit, which threads compile in the background before they are needed.

    XLA releases Python's lock while it compiles, so the programs of the next level compile while
    the present level runs. Levels and populations share programs of equal arguments. So do the
    steps before and after the exposures are known.

    `capacities` holds capacities by the name of the image size, from before the exposures are
    known. `waited_s` counts the seconds spent waiting for compilation; they do not count as time of
    steps.
    """

    def __init__(self):
        self.capacities: dict[str, Capacity] = {}
        self._made: dict[Hashable, Future] = {}
        self._ready: dict[tuple[Any, Key], Callable] = {}
        self._worker = ThreadPoolExecutor(WORKERS, thread_name_prefix="compile")
        self.waited_s = 0.0

    def expect(self, step: Any, key: Key, *arguments: Any, images: bool = True) -> list[Future]:
        """Begin to compile a step in the background; return its programs in their order.

        `step` takes the `arguments`; their shapes suffice. Without `images`, the middle program,
        which depends on the tone curve, is left out.
        """
        visible_only = step.settings("show")["cfg"].optimizer.visible_only
        rows = min(key.capacity.visible, key.slots) if visible_only else key.slots
        per_gaussian = (key.slots, rows, key.degree)
        shapes = {
            "show": per_gaussian,
            "differentiate": (key.size, key.capacity.entries, rows, key.pixels),
            "advance": per_gaussian,
        }
        keys = {
            name: (name, tuple(step.settings(name).values()), shape, key.structure)
            for name, shape in shapes.items()
        }
        static = {"capacity": key.capacity, "degree": key.degree}
        # The program that compiles longest comes first.
        wanted = ("differentiate", "show", "advance") if images else ("advance", "show")
        for name in wanted:
            if keys[name] not in self._made:
                trace = functools.partial(step.lowered, name, *_shapes(arguments), **static)
                self._made[keys[name]] = self._worker.submit(lambda trace=trace: trace().compile())
        return [self._made[keys[name]] for name in shapes if name in wanted]

    def ahead(self, key: Hashable, program, *arguments: Any, **static: Any) -> Callable:
        """Begin to compile another program in the background; return a function that calls it.

        `key` identifies the program. The returned function takes the arguments that are not static.
        """
        if key not in self._made:
            self._made[key] = self._worker.submit(
                lambda: program.lower(*_shapes(arguments), **static).compile()
            )
        future = self._made[key]
        return lambda *dynamic: self._wait(future)(*dynamic)

    def get(self, step: Any, key: Key, *arguments: Any):
        """Return a compiled step, `(state, batch, partner, controls) -> (state, report)`."""
        if (step, key) not in self._ready:
            parts = self.expect(step, key, *arguments)
            self._ready[step, key] = step.chained(*(self._wait(part) for part in parts))
        return self._ready[step, key]

    def _wait(self, future: Future):
        if future.done():
            return future.result()
        begin = time.monotonic()
        try:
            return future.result()
        finally:
            self.waited_s += time.monotonic() - begin

    def close(self) -> None:
        """Cancel the compilations that have not begun."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def _shapes(arguments):
    return jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=False), arguments
    )
