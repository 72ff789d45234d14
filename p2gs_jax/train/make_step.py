"""The training step for custom loops, with a custom loss, image formation and densification.

These need no change of this package. `fit` also takes `terms`, `formation` and `strategy`.
docs/api.md, "Ablations", has examples.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import DivergenceError
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.photometry.appearance import Formation
from p2gs_jax.render.capacity import Capacity
from p2gs_jax.train import state as states
from p2gs_jax.train import strategies
from p2gs_jax.train.capacities import capacity_for
from p2gs_jax.train.exposure_loss import Partner
from p2gs_jax.train.inputs import controls_at
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.step import Step
from p2gs_jax.train.strategies import Strategy
from p2gs_jax.train.terms import LossTerm
from p2gs_jax.train.update import StepReport, finite_names
from p2gs_jax.types import Array, Batch, Camera, Gaussians, Params, Photometry

# If `cfg` sets no bound, the population is bounded as in a fit of views of this many pixels.
PIXELS = 640 * 480


class Custom(NamedTuple):
    """Parts of a fit that replace parts of its configuration (`make_step`)."""

    terms: Mapping[str, LossTerm | None] | None = None  # loss terms by name
    formation: Formation | None = None  # an image formation, or None
    strategy: Strategy | None = None  # a densification, or None

    def among(self, params: Params) -> Params:
        """Return the parameters, including the parameters of a custom formation."""
        if self.formation is None:
            return params
        return dataclasses.replace(params, appearance=jax.tree.map(on_device, self.formation))


AS_CONFIGURED = Custom()


class TrainingStep:
    """A training step of one view, and a densification; `make_step` makes it.

    Each image size gets a tile-list capacity at its first view, and more after an overflow.
    """

    def __init__(self, cfg: FitConfig, custom: Custom, extent: float):
        self.cfg, self.extent, self.custom = cfg, extent, custom
        configured = strategies.make_strategy(cfg, Coverage(PIXELS, 1.0), ((1.0, 1),))
        self.strategy = custom.strategy or configured
        self.optimizer = make_optimizer(cfg)
        noise = getattr(self.strategy, "noise", None)
        self._step = Step(cfg, self.optimizer, extent, noise, custom.terms or {})
        self._host = states.HostState(pace=1.0 / max(cfg.train.steps, 1))
        self._capacities: dict[tuple[int, int], Capacity] = {}

    def start(self, gaussians: Gaussians, photometry: Photometry) -> states.FitState:
        """Return the state before the first step, with the Gaussians as seeds."""
        self._slots = strategies.started(self.strategy, gaussians.capacity)
        params = self.custom.among(Params(gaussians, photometry))
        alive = jnp.ones(gaussians.capacity, bool)
        return states.initial_state(params, alive, self.optimizer, self._slots.slots)

    def __call__(
        self,
        state: states.FitState,
        camera: Camera,
        photograph: Float[Array, "h w 3"] | UInt[Array, "h w 3"],
        view: int = 0,
        *,
        mask: Bool[Array, "h w"] | None = None,
        progress: float = 0.0,
    ) -> tuple[states.FitState, StepReport]:
        """Return the state after a step of one view, and its report; `state` is donated.

        `photograph` has display values in [0, 1], or unsigned integers whose largest value means 1;
        `view` is its row in `Photometry`. Pixels where `mask` is True count (None: all). `progress`
        is the completed fraction of the run, which sets learning rates and harmonics degree.
        DivergenceError: a loss term or gradient is not finite.
        """
        cfg, size = self.cfg, (camera.width, camera.height)
        mask = jnp.ones(size[::-1], bool) if mask is None else jnp.asarray(mask)
        batch = Batch(camera, jnp.asarray(photograph), mask, jnp.int32(view))
        controls = controls_at(progress, self._host.pace, 1.0, cfg)
        if size not in self._capacities:
            arrays = (state.params.gaussians, state.population.alive, camera)
            gaussians, alive, at = jax.tree.map(np.asarray, arrays)
            scene = (gaussians, alive, [at], self._slots.most)
            self._capacities[size] = capacity_for(*scene, cfg.render)
        while True:
            state, report = self._step(
                state,
                batch,
                Partner(jnp.int32(0)),
                controls,
                capacity=self._capacities[size],
                degree=cfg.render.sh_degree,
            )
            kind = int(state.fault.kind)
            if kind == states.FAULT_NONFINITE:
                name = finite_names(report.terms, state.params)[int(state.fault.term)]
                raise DivergenceError(
                    f"Step {int(state.step) + 1}: the {name} is not finite.",
                    fix="lower the learning rates (optimizer.*)",
                )
            if kind != states.FAULT_OVERFLOW:
                return state, report
            needed = int(state.fault.needed), int(state.fault.visible)
            self._capacities[size] = self._capacities[size].grown(*needed)
            state = states.healed(state)

    def densify(self, state: states.FitState, progress: float) -> states.FitState:
        """Return the state after a densification (donated); UserError: no Gaussian is left."""
        if self.strategy is None:
            return state
        self._host.step, self._host.progress = int(state.step), progress
        return strategies.densified(
            self.strategy,
            state,
            self._host,
            self.cfg,
            self.extent,
            self._slots.limit,
            lambda text: None,
        )


def make_step(
    cfg: FitConfig,
    *,
    terms: Mapping[str, LossTerm | None] | None = None,
    formation: Formation | None = None,
    strategy: Strategy | None = None,
    extent: float = 1.0,
) -> TrainingStep:
    """Return the training step of a configuration.

    Args:
        cfg: configuration of all parts that are not replaced below.
        terms: loss terms by name, added to the terms of `cfg` or replacing them; None removes a
            term. A term is a function of (Rendered, Target, Aux); see `train/terms.py`.
        formation: an image formation that replaces the tone curve: a pytree with
            `apply(radiance, capture)`, whose arrays are learned.
        strategy: densification: an object with `start(seeds)` and `densify(gaussians, population,
            now)`; see `train/strategies.py`. None: the densification of `cfg`.
        extent: scene extent, scene units; the learning rate of the means is a multiple of it.
    """
    return TrainingStep(cfg, Custom(terms, formation, strategy), extent)
