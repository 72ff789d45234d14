"""The host loop: bursts of jitted steps, and between them everything that changes shapes.

Within a burst the host only dispatches. After it the host reads the fault flag and the reports,
logs, lets the strategy densify, replans the pace and checkpoints. All decisions follow from the
seed and the step number (and, under a time budget, from paces that the checkpoint remembers), so a
resumed run takes the same path as an uninterrupted one: bit for bit on a CPU, and on GPUs as far as
their sums repeat (`RenderConfig.deterministic`).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool

from p2gs_jax.config import FitConfig
from p2gs_jax.core import interrupts
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.progress import LogRecord
from p2gs_jax.gaussians.population import STEP_SECONDS_PER_PIXEL, Coverage
from p2gs_jax.losses.relative_exposure import ColorPairs
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.train import room, schedule
from p2gs_jax.train.burst import Bursts
from p2gs_jax.train.checkpoints import RunCheckpoints, pause_between
from p2gs_jax.train.data_parallel import ParallelStep, Spread, default_mesh
from p2gs_jax.train.host import HostState
from p2gs_jax.train.inputs import InputSource
from p2gs_jax.train.level_programs import LevelPrograms
from p2gs_jax.train.log import RunLog, record_of
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.programs import StepPrograms
from p2gs_jax.train.schedule import Pace
from p2gs_jax.train.session import Session
from p2gs_jax.train.state import FitState, count_alive, initial_state
from p2gs_jax.train.step import Step
from p2gs_jax.train.strategies import RunContext, Strategy, make_strategy
from p2gs_jax.train.views import TrainingViews
from p2gs_jax.types import Gaussians, Params

NEARLY_DONE = 0.99


@dataclass(frozen=True)
class TrainResult:
    """The end of a run.

    Attributes:
        state: parameters and population.
        host: counters.
        max_gaussians: bound on the population.
        seconds: of this session, by name: compiling (waited for), steps, densification,
            checkpoints.
    """

    state: FitState
    host: HostState
    max_gaussians: int
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)


class Trainer:
    """Runs one fit from its initial parameters to its final ones.

    Args:
        cfg: everything.
        views: the training views.
        extent: scene extent, scene units.
        pairs: corresponding observations, for the relative-exposure readings that need them.
        coverage: how much of the scene the views show.
        run_dir: where `log.jsonl` and `checkpoints/` go.
        programs: compiled steps, some of them perhaps begun.
        decided: what the scene settled; a run that is resumed must have settled the same.
        on_log: called with every log record.
        on_message: called with everything the user must know.
        mesh: the devices of a step of several views; None: the default one.
    """

    def __init__(
        self,
        cfg: FitConfig,
        views: TrainingViews,
        extent: float,
        pairs: ColorPairs | None,
        coverage: Coverage,
        run_dir: Path,
        programs: StepPrograms,
        decided: Decisions,
        on_log: Callable[[LogRecord], None] = lambda record: None,
        on_message: Callable[[str], None] = lambda text: None,
        mesh: Mesh | None = None,
    ):
        self.cfg, self.views, self.coverage = cfg, views, coverage
        self.programs, self.on_message = programs, on_message
        sizes = [views.camera(i, 1) for i in range(len(views))]
        width, height = min(c.width for c in sizes), min(c.height for c in sizes)
        self.levels = schedule.levels(cfg.train, width, height)
        self.clock = Stopwatch()
        self.log = RunLog(run_dir, on_log)
        self.checkpoints = RunCheckpoints(run_dir, cfg, decided, on_message)
        self.asked = interrupts.Held()
        self.optimizer = make_optimizer(cfg)
        if cfg.train.batch > 1:
            mesh = mesh or default_mesh()
        step = Step(cfg, self.optimizer, extent)
        step = step if mesh is None else ParallelStep(step, mesh)
        self.spread = Spread(mesh)
        self.source = InputSource(cfg, views, pairs, coverage.shown)
        self.steps = LevelPrograms(cfg, step, programs, self.levels)
        self.bursts = Bursts(
            cfg.train,
            self.levels,
            self.source,
            self.steps,
            self.spread,
            self.checkpoints,
            self.clock,
        )
        self.context = RunContext(
            cfg=cfg,
            extent=extent,
            coverage=coverage,
            levels=self.levels,
            views=views,
            programs=programs,
            spread=self.spread,
            clock=self.clock,
            on_message=on_message,
        )

    def run(
        self,
        params: Params,
        alive,
        owner=None,
        *,
        resume: bool = False,
        spent_s: float = 0.0,
        finish_s: float = 0.0,
    ) -> TrainResult:
        """Optimise until the run is complete.

        Args:
            params: initial parameters.
            alive: which Gaussians exist.
            owner: the moving object that each belongs to, or None.
            resume: continue from the newest checkpoint, if there is one.
            spent_s: seconds of a time budget that are gone.
            finish_s: seconds of it to leave for what follows, on an unloaded machine.

        Raises:
            DivergenceError: a loss term or gradient is not finite.
            UserError: no Gaussian is left, or checkpoints cannot be continued from.
            Interrupted: a signal asked for the end; a checkpoint is written first.
        """
        strategy = make_strategy(self.context, int(np.sum(np.asarray(alive))))
        state = initial_state(params, alive, self.optimizer, strategy.slots, owner)
        pace = Pace.from_config(self.cfg.train, spent_s + finish_s)
        host = HostState(pace=pace.per_step)
        restored = self.checkpoints.restore(state) if resume else None
        if restored is None:
            self.log.clear()
        else:
            state, host = restored
            self.log.truncate(host.step)
            pace = dataclasses.replace(pace, per_step=host.pace)
        full_step_s = STEP_SECONDS_PER_PIXEL * self.coverage.pixels
        session = Session(pace, host, finish_s=finish_s, full_step_s=full_step_s)
        population = state.population
        self._allocate(state.params.gaussians, population.alive, population.owner, host, strategy)
        state = self.spread.spread(state)
        self._expect(state, host, strategy)
        with interrupts.held() as self.asked:
            state = self._loop(state, host, session, strategy)
            state = self.spread.whole(state)
            self._save(state, host)
        return TrainResult(
            state,
            host,
            strategy.limit or state.params.gaussians.capacity,
            {"compiling": self.programs.waited_s, **self.clock.seconds},
        )

    def expect(self, params: Params, owner, images: bool) -> None:
        """Begin to compile the steps of a run before its colours and exposures are known.

        Args:
            params: as the run will have them, as far as they are known.
            owner: see `run`.
            images: the tone curve is known.
        """
        seeds = params.gaussians.capacity
        strategy = make_strategy(self.context, seeds)
        alive, host = np.ones(seeds, bool), HostState(rooms=dict(self.programs.rooms))
        self._allocate(params.gaussians, alive, owner, host, strategy)
        self.programs.rooms = dict(host.rooms)
        start = functools.partial(initial_state, optimizer=self.optimizer, slots=strategy.slots)
        self._expect(jax.eval_shape(start, params, alive, owner=owner), host, strategy, images)

    def _loop(
        self, state: FitState, host: HostState, session: Session, strategy: Strategy
    ) -> FitState:
        """Take bursts until the run is complete, or its time over."""
        saved, pause = host.elapsed_s, self.cfg.train.checkpoint_every_s
        while not schedule.is_over(host.progress, host.pace):
            state, stepped = self._take_burst(state, host, session)
            if stepped:
                state = strategy.update(state, host)
            session.replan(host)
            if session.over(host):
                if host.progress < NEARLY_DONE:
                    self.on_message(
                        f"The budget ended the run at {host.progress:.0%} of its schedule: fit "
                        "again with a longer --budget; what was compiled now is kept."
                    )
                break
            asked = self.asked.arrived
            if asked is not None or host.elapsed_s - saved > pause:
                begun = host.elapsed_s
                self._save(self.spread.whole(state), host)
                session.tick(host)
                saved = host.elapsed_s
                pause = pause_between(self.cfg.train.checkpoint_every_s, saved - begun)
            if asked is not None:
                self.on_message(
                    f"{interrupts.name_of(asked)}: the run stops after step {host.step} "
                    f"({host.progress:.0%}), where a checkpoint is written; --resume continues it."
                )
                self.asked.deliver()
        return state

    def _take_burst(
        self, state: FitState, host: HostState, session: Session
    ) -> tuple[FitState, bool]:
        """Take a burst of steps and log it; return the state, and whether there were any."""
        state, reports = self.bursts.take(state, host)
        session.tick(host)
        if reports:
            left_s = session.left(host, self.levels)
            alive = count_alive(state)
            record = record_of(reports, host, alive, host.shrink, left_s=left_s)
            self.log.append(record)
            # From here on a signal waits for the next place to continue from.
            self.asked.begin()
        return state, bool(reports)

    def _save(self, state: FitState, host: HostState) -> None:
        with self.clock("checkpoints"):
            self.checkpoints.save(state, host)

    def _allocate(
        self, gaussians: Gaussians, alive: Bool, owner, host: HostState, strategy: Strategy
    ) -> None:
        """Make room for the image sizes to come."""
        host.rooms = room.allocate(
            host.rooms,
            self.programs.rooms,
            self.views,
            schedule.shrinks_left(host.progress, self.levels),
            gaussians,
            alive,
            strategy.most,
            self.cfg.render,
            owner,
        )

    def _expect(
        self, state: FitState, host: HostState, strategy: Strategy, images: bool = True
    ) -> None:
        """Begin to compile what is known of the steps to come.

        Args:
            state: to start from, or its shapes.
            host: how far the run is, and its rooms.
            strategy: whether slots stay; it may have programs of its own.
            images: see `expect`.
        """
        if not strategy.slots_stay:
            return
        for number, shrink in enumerate(self.steps.ahead(host.progress, self.views)):
            inputs = self.source.at(host.step, 0.0, host.pace, shrink)
            self.steps.expect(state, inputs, host, shrink, images)
            if number == 0:
                strategy.expect(state)  # wanted soon after the first step
