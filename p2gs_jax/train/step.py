"""One optimisation step: three pure jitted functions, one after the other, compiled ahead.

The first and the last work per Gaussian and know no image size, so all levels of a fit share them;
the one between knows neither the population nor the optimiser. In one program, every level compiled
all of it (BUILD_NOTES, "A step is three programs").
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
from p2gs_jax.render.capacity import Room
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.exposure_loss import Partner
from p2gs_jax.train.image_gradient import differentiate, show
from p2gs_jax.train.optimizer import Optimizer
from p2gs_jax.train.state import FitState
from p2gs_jax.train.terms import LossTerm, loss_terms
from p2gs_jax.train.update import Controls, StepReport, advance
from p2gs_jax.types import Batch, Frustum

# What each program takes of the configuration; None: all of it. Fits that differ elsewhere share
# the program, and a program that reads anything else raises AttributeError.
FORMED = ("curve", "spline", "pivot", "clamp", "cameras", "appearance")
TAKEN: dict[str, dict[str, Any]] = {
    "show": {"render": None, "optimizer": ("visible_only",)},
    "differentiate": {
        "render": None,
        "photometry": FORMED,
        "loss": ("censored", "saturation"),
    },
    "advance": {
        "render": None,
        "optimizer": None,
        "photometry": ("model", "start", "freeze_until", "white_balance"),
        "loss": {"regularizers": ("log_exposure_mean",)},
    },
}

# The first step waits for two programs of about equal size; but XLA itself compiles on several
# cores, and two at once on two cores take three times as long each (ours: BUILD_NOTES).
WORKERS = 1 if available_cores() <= 2 else 2


PROGRAMS: dict[str, Callable[..., Any]] = {
    "show": show,
    "differentiate": differentiate,
    "advance": advance,
}


@functools.cache
def compiled(name: str, **static: Any) -> Any:
    """Return a part of a step, jitted; the same where what is static is."""
    # On first use: the options depend on the backend.
    body = functools.partial(PROGRAMS[name], **static)
    donated = (0,) if name == "advance" else ()
    return jax.jit(body, compiler_options=compiler_options(), donate_argnums=donated)


@functools.cache
def compiled_over(kind: type[MeshStep], name: str, *, mesh: Mesh, **static: Any) -> Any:
    """Return a part of a step, divided over the devices of a mesh, jitted.

    It takes arrays of the host.
    """
    body, into, out = kind.programs[name]
    each = functools.partial(body, **static)
    placed = jax.tree.map(
        lambda spec: NamedSharding(mesh, spec),
        (into, out),
        is_leaf=lambda spec: isinstance(spec, P),
    )
    return jax.jit(
        jax.shard_map(each, mesh=mesh, in_specs=into, out_specs=out, check_vma=False),
        in_shardings=placed[0],
        out_shardings=placed[1],
        compiler_options=compiler_options(),
        donate_argnums=(0,) if name == "advance" else (),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """The step `(state, batch, partner, controls, room=..., degree=...)` of a fit.

    It gives the next state and a report; the state before is donated. Randomness follows from the
    seed and the step number alone. The loss is that of `image_loss`. What is done per Gaussian is
    done in blocks, for those that the view may show; the others rest
    (`OptimizerConfig.visible_only`). What happens where something does not fit or is not finite:
    `train/update.py`.
    """

    cfg: FitConfig  # everything
    optimizer: Optimizer  # from `make_optimizer`
    extent: float  # scene extent, scene units
    noise: float | None = None  # scale of the exploration noise, or None (`strategies.Strategy`)
    # loss terms that differ from those of `cfg`; see `loss_terms`
    terms: Mapping[str, LossTerm | None] = dataclasses.field(default_factory=dict)
    _ready: dict[Any, Callable] = dataclasses.field(default_factory=dict, init=False)

    def __call__(
        self,
        state: FitState,
        batch: Batch,
        partner: Partner,
        controls: Controls,
        *,
        room: Room,
        degree: int,
    ) -> tuple[FitState, StepReport]:
        """Take a step, compiling it on first use."""
        if (room, degree) not in self._ready:
            parts = (self.program(name, room, degree) for name in PROGRAMS)
            self._ready[room, degree] = self.chained(*parts)
        return self._ready[room, degree](state, batch, partner, controls)

    def chained(self, show, differentiate, advance):
        """Return the step made of its three programs, compiled or not."""

        def step(state: FitState, batch: Batch, partner: Partner, controls: Controls):
            params, frustum = state.params, self.frustum(batch)
            listed = show(*per_gaussian(state, frustum, controls))
            gradient = differentiate(
                listed.shown, params.photometry, params.appearance, batch, partner
            )
            return advance(state, listed.ids, listed.visible, gradient, frustum, controls)

        return step

    def settings(self, name: str) -> dict[str, Any]:
        """Return what one of the three programs takes from the configuration, by argument."""
        cfg = narrowed(self.cfg, TAKEN[name])
        if name == "show":
            return {"cfg": cfg}
        if name == "differentiate":
            known = dataclasses.replace(self.cfg, photometry=cfg.photometry)
            return {"cfg": cfg, "terms": tuple(loss_terms(known, self.terms).items())}
        return {"cfg": cfg, "optimizer": self.optimizer, "extent": self.extent, "noise": self.noise}

    def lowered(
        self, name: str, state: FitState, batch, partner, controls, *, room: Room, degree: int
    ):
        """Return one of the three programs, by its name, traced for arguments of these shapes."""
        program = functools.partial(self.program, room=room, degree=degree)
        frustum, params = jax.eval_shape(self.frustum, batch), state.params
        arguments = per_gaussian(state, frustum, controls)
        if name == "show":
            return program(name).lower(*arguments)
        listed = program("show").eval_shape(*arguments)
        image = (listed.shown, params.photometry, params.appearance, batch, partner)
        if name == "differentiate":
            return program(name).lower(*image)
        gradient = program("differentiate").eval_shape(*image)
        moved = (state, listed.ids, listed.visible, gradient, frustum, controls)
        return program(name).lower(*moved)

    # What steps on several devices do otherwise: `divided.py`, `data_parallel.py`.

    def program(self, name: str, room: Room, degree: int) -> Any:
        """Return one of the three programs, jitted."""
        return compiled(name, **self.settings(name), **static_sizes(name, room, degree))

    def frustum(self, batch: Batch) -> Frustum:
        """Return the view of a step, for the programs that know no image size."""
        c = batch.camera
        width, height = map(c.K.dtype.type, (c.width, c.height))
        return on_host(Frustum, c.viewmat, c.K, width, height, c.objects)

    def slots(self, count: int) -> int:
        """Return how many slots a population has that is to have `count` or more."""
        return count

    def spread(self, state: FitState) -> FitState:
        """Return a state as steps take it."""
        return state

    def whole(self, state: FitState) -> FitState:
        """Return a state of steps on the default device, for what looks at all Gaussians."""
        return state


@dataclasses.dataclass(frozen=True, eq=False)
class MeshStep(Step):
    """A step whose programs are divided over the devices of a mesh."""

    # Of each program: what each device does, and how its arguments and its results are divided.
    programs: ClassVar[dict[str, tuple[Any, Any, Any]]]
    mesh: Mesh = dataclasses.field(kw_only=True)

    def settings(self, name: str) -> dict[str, Any]:
        """Return what one of the three programs takes from the configuration, by argument."""
        return super().settings(name) | {"mesh": self.mesh}

    def program(self, name: str, room: Room, degree: int) -> Any:
        """Return one of the three programs, divided over the mesh and jitted."""
        static = self.settings(name) | static_sizes(name, room, degree)
        return compiled_over(type(self), name, **static)


def static_sizes(name: str, room: Room, degree: int) -> dict[str, int]:
    """Return the static sizes of one of the three programs, by argument."""
    if name == "show":
        return {"room": room.visible, "degree": degree}
    return {"room": room.entries} if name == "differentiate" else {"degree": degree}


def per_gaussian(state: FitState, frustum: Frustum, controls: Controls) -> tuple:
    """Return the arguments of `show`."""
    params, population = state.params, state.population
    return params.gaussians, population.alive, frustum, controls.active_degree, population.owner


# ----------------------------------------------------------------------- compiled ahead


class Key(NamedTuple):
    """What a step is compiled for."""

    size: tuple[int, int]  # image width and height, pixels
    slots: int  # room of the population
    room: Room  # of a view
    degree: int  # highest spherical-harmonics degree in use
    pixels: str  # type of the photograph as it is stored
    structure: Hashable = None  # what the state, and what comes with a photograph, consist of


class StepPrograms:
    """The compiled steps of a fit, made in the background ahead of their turn.

    XLA holds no lock of Python's while it compiles, so the program of the next level is made while
    the present one runs. Levels and populations share those of the three programs of a step that
    they can, and so do a step that was made before the exposures were known and the one that was
    made after.

    Attributes:
        rooms: of the image sizes, by name, for which programs were begun before the start.
        waited_s: seconds for which a program was waited for; they never count as pace.
    """

    def __init__(self):
        self.rooms: dict[str, Room] = {}
        self._made: dict[Hashable, Future] = {}
        self._ready: dict[tuple[Any, Key], Callable] = {}
        self._worker = ThreadPoolExecutor(WORKERS, thread_name_prefix="compile")
        self.waited_s = 0.0

    def expect(self, step: Any, key: Key, *arguments: Any, images: bool = True) -> list[Future]:
        """Begin to compile a step in the background.

        `step` is a `Step`, or one of several views; `arguments` are its own, or their shapes.
        Without `images`, the program between waits, which knows the tone curve. Returned are the
        programs in their order.
        """
        visible_only = step.settings("show")["cfg"].optimizer.visible_only
        rows = min(key.room.visible, key.slots) if visible_only else key.slots
        of_gaussians = (key.slots, rows, key.degree)
        shapes = {
            "show": of_gaussians,
            "differentiate": (key.size, key.room.entries, rows, key.pixels),
            "advance": of_gaussians,
        }
        keys = {
            name: (name, tuple(step.settings(name).values()), shape, key.structure)
            for name, shape in shapes.items()
        }
        # The longest first.
        wanted = ("differentiate", "show", "advance") if images else ("advance", "show")
        for name in wanted:
            if keys[name] not in self._made:
                lowered = functools.partial(step.lowered, name, *_shapes(arguments))
                self._made[keys[name]] = self._worker.submit(
                    lambda lowered=lowered: lowered(room=key.room, degree=key.degree).compile()
                )
        return [self._made[keys[name]] for name in shapes if name in wanted]

    def ahead(self, key: Hashable, program, *arguments: Any, **static: Any) -> Callable:
        """Begin to compile another program in the background, and return it.

        `key` tells it from others; the returned function is called without the static arguments.
        """
        if key not in self._made:
            self._made[key] = self._worker.submit(
                lambda: program.lower(*_shapes(arguments), **static).compile()
            )
        future = self._made[key]
        return lambda *given: self._wait(future)(*given)

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
        """Forget programs whose compilation has not begun."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def _shapes(arguments):
    return jax.tree.map(
        lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=False), arguments
    )
