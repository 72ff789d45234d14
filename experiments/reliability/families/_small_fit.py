"""A small fit, prepared once and taken as often as wanted, each time a little otherwise."""

from __future__ import annotations

import dataclasses
import itertools
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from reliability.families._scenes import Made, write_scene

from p2gs_jax.config import preset
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.progress import Silent
from p2gs_jax.evaluate.evaluate import evaluate
from p2gs_jax.jobs.configs import (
    with_fields,
)
from p2gs_jax.pipeline.fit import compact, optimise
from p2gs_jax.pipeline.prepare import load, prepare
from p2gs_jax.render.capacity import (
    make_renderer,
)
from p2gs_jax.run.folder import (
    RunFolder,
)
from p2gs_jax.train.loop import TrainResult
from p2gs_jax.train.programs import Key, StepPrograms
from p2gs_jax.train.state import FitState
from p2gs_jax.train.step import Step
from p2gs_jax.types import Params

VIEWS = 12
MADE = Made(
    views=VIEWS,
    points=400,
    sizes=((96, 72),),
    exposures=tuple(np.random.default_rng(1).normal(0, 0.5, VIEWS).tolist()),
)
# One level and one model: what is tried is arithmetic, not what a fit decides.
OPTIONS = {
    "train.coarse_to_fine": [],
    "train.checkpoint_every_s": 1e9,
    "densify.max_gaussians": 2000,
    "render.sh_degree": 2,
    "init.shell": "off",
    "init.dense": "off",
    "photometry.select": False,
    "photometry.model": "view_exposure_gamma",
    "photometry.freeze_until": 0.0,
}


class Called(NamedTuple):
    """A step that is about to be taken.

    Attributes:
        step: the uncompiled one.
        key: what it was compiled for.
        run: the compiled one, `(state, batch, partner, controls) -> (state, report)`.
    """

    step: Step
    key: Key
    run: Callable[..., Any]


Watch = Callable[[Called, FitState, tuple], Any]
"""Is given a step, a state and the other arguments; returns what the step does."""


def as_it_is(called: Called, state: FitState, inputs: tuple) -> Any:
    """Take a step."""
    return called.run(state, *inputs)


class Watched(StepPrograms):
    """Compiled steps that are taken by a function.

    Attributes:
        watch: that function.
    """

    def __init__(self):
        super().__init__()
        self.watch: Watch = as_it_is

    def get(self, step, key, *arguments):
        """Return a compiled step under watch."""
        assert isinstance(step, Step)
        called = Called(step, key, super().get(step, key, *arguments))
        return lambda state, *inputs: self.watch(called, state, inputs)


@dataclass(frozen=True)
class Ended:
    """The end of a fit.

    Attributes:
        state: on the host.
        psnr: of the held-out views, each under the exposure that fits it best, dB.
        ev: exposure of every training view, stops, mean 0.
        ev_error: root mean square of their errors, stops.
    """

    state: FitState
    psnr: float
    ev: Float[np.ndarray, " v"]
    ev_error: float


class SmallFit:
    """A scene of dots, ready to be fitted.

    Args:
        folder: empty; scene and runs go there.
    """

    def __init__(self, folder: Path):
        self.folder, self.programs = folder, Watched()
        cfg = with_fields(preset("robust"), OPTIONS)
        scene_dir = write_scene(folder / "scene", MADE)
        scene = load(scene_dir, folder / "run", cfg, Silent())
        self.prepared = prepare(scene, cfg, Silent(), Stopwatch())
        self._render = make_renderer(self.prepared.cfg.render)
        self._numbers = itertools.count()

    def taken(
        self,
        options: Mapping[str, object],
        params: Params | None = None,
        *,
        watch: Watch = as_it_is,
    ) -> TrainResult:
        """Fit.

        Args:
            options: beside `OPTIONS`; nothing that decides how a fit starts.
            params: to start from; None: those of the scene.
            watch: takes the steps.
        """
        prepared = self.prepared
        cfg = with_fields(prepared.cfg, dict(options))
        prepared = dataclasses.replace(prepared, cfg=cfg, params=params or prepared.params)
        root = self.folder / f"run{next(self._numbers)}"
        root.mkdir()
        self.programs.watch = watch
        found = optimise(prepared, RunFolder(root), Silent(), self.programs, resume=False)
        shutil.rmtree(root)
        return found

    def judged(self, found: TrainResult) -> Ended:
        """Score the end of a fit."""
        prepared = self.prepared
        fitted, _ = compact(found)
        metrics = evaluate(
            fitted,
            np.ones(fitted.gaussians.capacity, bool),
            prepared.scene,
            prepared.store,
            self._render,
            prepared.cfg,
        )
        ev = np.log2(np.asarray(fitted.photometry.exposures, np.float64))
        true = np.asarray(MADE.exposures)[list(prepared.scene.train_indices)]
        ev, true = ev - ev.mean(), true - true.mean()
        return Ended(
            jax.device_get(found.state),
            metrics["test"]["exposure_fitted"]["psnr"],
            ev,
            float(np.sqrt(np.mean((ev - true) ** 2))),
        )
