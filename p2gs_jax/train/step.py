"""One optimisation step: three pure jitted functions, one after the other.

The first and the last work per Gaussian and know no image size, so all levels of a fit share them;
the one between knows neither the population nor the optimiser. In one program, every level compiled
all of it (BUILD_NOTES, "A step is three programs").
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax

from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.losses.total import Partner, partner_cameras
from p2gs_jax.render.capacity import Room
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.advance import Controls, StepReport, advance
from p2gs_jax.train.image_gradient import differentiate, show
from p2gs_jax.train.optimizer import Optimizer
from p2gs_jax.train.state import FitState
from p2gs_jax.types import Batch, Frustum

PARTS = ("show", "differentiate", "advance")


@functools.cache
def _compiled(name: str) -> Any:
    """Return a part of a step, jitted; on first use, since its options depend on the backend.

    What a part takes from the configuration is static: steps of several fits share programs.
    """
    options: dict[str, Any] = {"compiler_options": compiler_options()}
    if name == "show":
        return jax.jit(show, static_argnames=("cfg", "visible_only", "room", "degree"), **options)
    if name == "differentiate":
        return jax.jit(differentiate, static_argnames=("cfg", "room"), **options)
    static = ("cfg", "optimizer", "extent", "degree")
    return jax.jit(advance, static_argnames=static, donate_argnames="state", **options)


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """The step `(state, batch, partner, controls, room=..., degree=...)` of a fit.

    It gives the next state and a report; the state before is donated. Randomness follows from the
    seed and the step number alone.

    The loss is that of `total_loss`. What is done per Gaussian is done in blocks, for those that
    the view may show; the others rest (`OptimizerConfig.visible_only`). What happens where
    something does not fit or is not finite: `train/advance.py`.

    Attributes:
        cfg: everything.
        optimizer: from `make_optimizer`.
        extent: scene extent, scene units.
    """

    cfg: FitConfig
    optimizer: Optimizer
    extent: float

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
        parts = (
            functools.partial(
                _compiled(name), **self.settings(name), **static_sizes(name, room, degree)
            )
            for name in PARTS
        )
        return self.chained(*parts)(state, batch, partner, controls)

    def chained(self, show, differentiate, advance):
        """Return the step made of its three programs, compiled or not."""

        def step(state: FitState, batch: Batch, partner: Partner, controls: Controls):
            params, frusta = state.params, self.frusta(batch, partner)
            listed = show(*per_gaussian(state, frusta, controls))
            gradient = differentiate(
                listed.shown, params.photometry, params.appearance, batch, partner
            )
            return advance(state, listed.ids, listed.visible, gradient, frusta, controls)

        return step

    def settings(self, name: str) -> dict[str, Any]:
        """Return what one of the three programs takes from the configuration, by argument.

        Everything else is as in `FitConfig()`: programs are shared by fits that differ there.
        Neither knows the curve but `differentiate`; that does not know which exposures move. White
        balance and cameras decide what `Photometry` consists of, which both take.
        """
        cfg, p = self.cfg, self.cfg.photometry
        if name == "show":
            return {"cfg": cfg.render, "visible_only": cfg.optimizer.visible_only}
        known = dataclasses.replace(FitConfig(), render=cfg.render, loss=cfg.loss)
        if name == "differentiate":
            photometry = dataclasses.replace(p, model="constant")
            return {"cfg": dataclasses.replace(known, photometry=photometry)}
        moving = PhotometryConfig(
            model=p.model,
            start=p.start,
            freeze_until=p.freeze_until,
            white_balance=p.white_balance,
            cameras=p.cameras,
        )
        known = dataclasses.replace(
            known,
            densify=cfg.densify,
            optimizer=cfg.optimizer,
            photometry=moving,
        )
        return {"cfg": known, "optimizer": self.optimizer, "extent": self.extent}

    def lowered(
        self, name: str, state: FitState, batch, partner, controls, *, room: Room, degree: int
    ):
        """Return one of the three programs, by its name, traced for arguments of these shapes."""
        program = {name: _compiled(name) for name in PARTS}
        static = {n: self.settings(n) | static_sizes(n, room, degree) for n in PARTS}
        params, frusta = state.params, self.frusta(batch, partner)
        arguments = per_gaussian(state, frusta, controls)
        if name == "show":
            return program[name].lower(*arguments, **static[name])
        listed = program["show"].eval_shape(*arguments, **static["show"])
        image = (listed.shown, params.photometry, params.appearance, batch, partner)
        if name == "differentiate":
            return program[name].lower(*image, **static[name])
        gradient = program["differentiate"].eval_shape(*image, **static["differentiate"])
        moved = (state, listed.ids, listed.visible, gradient, frusta, controls)
        return program[name].lower(*moved, **static[name])

    def frusta(self, batch: Batch, partner: Partner) -> tuple[Frustum, ...]:
        """Return the views of a step, for the programs that know no image size."""
        cameras = (batch.camera, *partner_cameras(partner, self.cfg))
        sizes = (map(c.K.dtype.type, (c.width, c.height)) for c in cameras)
        return tuple(
            on_host(Frustum, c.viewmat, c.K, width, height, c.objects)
            for c, (width, height) in zip(cameras, sizes, strict=True)
        )


def static_sizes(name: str, room: Room, degree: int) -> dict[str, int]:
    """Return the static sizes of one of the three programs, by argument."""
    if name == "show":
        return {"room": room.visible, "degree": degree}
    return {"room": room.entries} if name == "differentiate" else {"degree": degree}


def per_gaussian(state: FitState, frusta: tuple[Frustum, ...], controls: Controls) -> tuple:
    """Return the arguments of `show`."""
    params, population = state.params, state.population
    degree = controls.active_degree
    return params.gaussians, population.alive, frusta, degree, population.owner


def compilations() -> int:
    """Return of the most often compiled part of steps how often it was, in this process.

    Programs that `StepPrograms` compiled are not counted.
    """
    return max(_compiled(name)._cache_size() for name in PARTS)
