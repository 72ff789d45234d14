"""The host loop: bursts of jitted steps, and between them all operations that change shapes.

Within a burst the host only dispatches steps. Afterwards it reads the fault flag and the reports,
logs, lets the strategy densify, replans the progress per step and writes checkpoints. All decisions
depend on the seed and the step number; under a time budget they also depend on the progress per
step, which checkpoints hold. So a resumed run computes the same as an uninterrupted run: bit for
bit on a CPU, and on GPUs if sums are repeatable (`RenderConfig.deterministic`).
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh

from p2gs_jax.config import FitConfig
from p2gs_jax.core import interrupts
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.progress import LogRecord
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.errors import DivergenceError
from p2gs_jax.gaussians.population import Coverage, step_seconds
from p2gs_jax.render.capacity import MOST_CANVASES
from p2gs_jax.render.cores import CORES
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.scene.pixels.store import DECODERS
from p2gs_jax.train import capacities, schedule, strategies
from p2gs_jax.train.data_parallel import VIEWS, ParallelStep
from p2gs_jax.train.divided import DividedStep
from p2gs_jax.train.exposure_loss import ColorPairs
from p2gs_jax.train.inputs import Inputs, TrainingViews, controls_at, inputs_at
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.records import Records
from p2gs_jax.train.schedule import RunClock
from p2gs_jax.train.state import (
    FAULT_NONFINITE,
    FAULT_OVERFLOW,
    FitState,
    HostState,
    alive_in,
    grow_state,
    healed,
    initial_state,
)
from p2gs_jax.train.step import Key, Step, StepPrograms
from p2gs_jax.train.strategies import Strategy
from p2gs_jax.train.terms import LossTerm
from p2gs_jax.train.update import StepReport, finite_names
from p2gs_jax.types import Gaussians, Params

NEARLY_DONE = 0.99  # progress from which on a note about an early end is left out
MAX_BURST = 50  # views
# Weight of a new measurement in the running mean of the seconds per view.
PACE_SHARE = 0.3
# Share of a run's time that writing checkpoints may take, and the longest pause between them as a
# multiple of `train.checkpoint_every_s`.
SAVING_SHARE, LONGEST_PAUSE = 0.01, 20.0


@dataclass(frozen=True)
class TrainResult:
    """The result of a run: state, counters, and the seconds of this session.

    `seconds` has the keys compiling (waiting only), steps, densification and checkpoints.
    """

    state: FitState
    host: HostState
    seconds: dict[str, float]


@dataclass(eq=False)
class Trainer:
    """Runs one fit from its initial to its final parameters.

    A custom image formation is passed as `params.appearance` of `run`.
    """

    cfg: FitConfig
    views: TrainingViews
    extent: float  # scene extent, scene units
    # colours of the same points in two views, if the relative-exposure loss compares photographs
    pairs: ColorPairs | None
    coverage: Coverage  # pixels of a view, and the share of the scene that it shows
    run_dir: Path  # folder of `log.jsonl` and `checkpoints/`
    programs: StepPrograms  # compiled steps; some compilations may have begun
    decided: Decisions  # options chosen from the scene; a resumed run must choose the same
    on_log: Callable[[LogRecord], None] = lambda record: None
    on_message: Callable[[str], None] = lambda text: None  # receives messages to the user
    mesh: Mesh | None = None  # the devices of a step, from `mesh_of`
    # loss terms by name, added to the terms of `cfg` or replacing them; None removes a term
    terms: Mapping[str, LossTerm | None] | None = None
    strategy: Strategy | None = None  # densification; None: the strategy that `cfg` names
    now: Callable[[], float] = time.monotonic  # monotonic clock, seconds
    store: CheckpointStore | None = None  # of checkpoints; None: in `run_dir/checkpoints`
    # called between bursts with a function that returns the state, and whether the run stops here
    look: Callable[[Callable[[], FitState], bool], None] = lambda state, stops: None

    def __post_init__(self):
        cfg, views = self.cfg, self.views
        cameras = [views.camera(i, 1) for i in range(len(views))]
        width, height = min(c.width for c in cameras), min(c.height for c in cameras)
        self.levels = schedule.levels(cfg.train, width, height)
        self.stopwatch = Stopwatch()
        store = self.store or CheckpointStore(self.run_dir / "checkpoints")
        sinks = (self.on_log, self.on_message)
        self.records = Records(self.run_dir, store, cfg, self.decided, *sinks)
        self.signals = interrupts.Held()
        self.optimizer = make_optimizer(cfg)
        configured = strategies.make_strategy(cfg, self.coverage, self.levels)
        self.densification = self.strategy or configured
        noise = getattr(self.densification, "noise", None)
        step_args = (cfg, self.optimizer, self.extent, noise, self.terms or {})
        kinds = {VIEWS: ParallelStep, CORES: DividedStep}
        self.step = Step(*step_args)
        if self.mesh is not None:
            self.step = kinds[self.mesh.axis_names[0]](*step_args, mesh=self.mesh)

    def run(
        self,
        params: Params,
        alive,
        owner=None,
        *,
        on_begin: Callable[[], None] = lambda: None,
        resume: bool = False,
        spent_s: float = 0.0,
        finish_s: float = 0.0,
    ) -> TrainResult:
        """Optimise until the run is complete, from initial parameters or the newest checkpoint.

        `alive` flags the Gaussians that exist; `owner` is the moving object of each Gaussian.
        `on_begin` is called before the first step, once a checkpoint is read. A time budget loses
        `spent_s` seconds used before the run. It also reserves `finish_s` seconds for evaluation
        and export, as measured on an unloaded machine. Raises DivergenceError: a loss term or
        gradient is not finite. Raises UserError: no Gaussian is left, or no checkpoint can be
        resumed. Raises Interrupted: a signal ended the run; a checkpoint is written first.
        """
        self.slots = strategies.started(self.densification, int(np.sum(np.asarray(alive))))
        state = initial_state(params, alive, self.optimizer, self.slots.slots, owner)
        train = self.cfg.train
        planned = float(train.budget_s or train.steps)
        host = HostState(planned=planned, pace=1.0 / max(train.steps, 1))
        state, host = self.records.begin(state, planned, resume) or (state, host)
        on_begin()
        # A resumed run with a longer plan may need more slots than its checkpoint has.
        state = grow_state(state, self.step.slots(self.slots.slots))
        # On GPUs the host limits the speed of short steps, which says nothing about evaluation.
        on_cpu = jax.default_backend() == "cpu"
        full_step_s = step_seconds(self.coverage.pixels) if on_cpu else math.inf
        seconds = {"spent_s": spent_s, "finish_s": finish_s, "full_step_s": full_step_s}
        clock = RunClock(self.cfg.train, host, **seconds, now=self.now)
        population = state.population
        self._allocate(state.params.gaussians, population.alive, population.owner, host)
        state = self.step.spread(state)
        self._expect(state, host)
        with interrupts.held() as self.signals:
            state = self._loop(state, host, clock)
            state = self.step.whole(state)
            self._save(state, host)
        seconds = {"compiling": self.programs.waited_s, **self.stopwatch.seconds}
        return TrainResult(state, host, seconds)

    def expect(self, params: Params, owner, images: bool) -> None:
        """Begin to compile the steps of a run before its colours and exposures are known.

        `params` have the shapes of the run's parameters. `images` is true if the tone curve is
        known: then the middle program of each step can be compiled, too.
        """
        seeds = params.gaussians.capacity
        self.slots = strategies.started(self.densification, seeds)
        alive, host = np.ones(seeds, bool), HostState(rooms=dict(self.programs.capacities))
        self._allocate(params.gaussians, alive, owner, host)
        self.programs.capacities = dict(host.rooms)
        slots = self.step.slots(self.slots.slots)
        start = functools.partial(initial_state, optimizer=self.optimizer, slots=slots)
        self._expect(jax.eval_shape(start, params, alive, owner=owner), host, images)

    # ------------------------------------------------------------------ bursts of steps

    def _loop(self, state: FitState, host: HostState, clock: RunClock) -> FitState:
        """Run bursts until the run is complete or its time is over."""
        every_s = self.cfg.train.checkpoint_every_s
        saved, pause = host.elapsed_s, every_s
        while not schedule.is_over(host.progress, host.pace):
            state, reports = self._take_burst(state, host)
            clock.tick(host)
            if reports:
                alive, left_s = alive_in(state.population), clock.left(host, self.levels)
                self.records.log(reports, host, alive, left_s)
                # From here on a signal waits until a checkpoint can be written.
                self.signals.begin()
                state = self._densified(state, host)
            clock.replan(host)
            if clock.over(host):
                if host.progress < NEARLY_DONE:
                    self.on_message(
                        f"The budget ended the run at {host.progress:.0%} of its schedule: "
                        "`fit --resume` with a longer --budget continues it."
                    )
                break
            signal = self.signals.arrived
            if signal is not None or host.elapsed_s - saved > pause:
                save_began = host.elapsed_s
                self._save(self.step.whole(state), host)
                clock.tick(host)
                saved = host.elapsed_s
                pause = (saved - save_began) / SAVING_SHARE
                pause = max(every_s, min(pause, LONGEST_PAUSE * every_s))
            self.look(functools.partial(self.step.whole, state), signal is not None)
            if signal is not None:
                self.on_message(
                    f"{interrupts.name_of(signal)}: the run stops after step {host.step} "
                    f"({host.progress:.0%}), where a checkpoint is written."
                )
                self.signals.deliver()
        return state

    def _take_burst(self, state: FitState, host: HostState) -> tuple[FitState, list[StepReport]]:
        """Dispatch steps up to the next log record, then read the fault; return completed reports.

        After an overflow, the steps that changed nothing do not count, and the capacity grows. The
        state is donated, and the counters of `host` change. Raises DivergenceError: a loss term or
        gradient is not finite.
        """
        shrink = schedule.shrink_at(host.progress, self.levels)
        if shrink != host.shrink:
            host.shrink, host.step_s = shrink, 0.0
            return_freed_memory()
        begin, waited = self.now(), self.programs.waited_s
        state, reports, sizes = self._dispatched(state, host)
        kind = int(state.fault.kind)
        done = int(state.step) - host.step
        completed = done // self.cfg.train.batch
        seconds = self.now() - begin - (self.programs.waited_s - waited)
        self.stopwatch.add("steps", seconds)
        if kind == FAULT_NONFINITE:
            name = finite_names(reports[completed].terms, state.params)[int(state.fault.term)]
            raise DivergenceError(
                f"Step {host.step + done + 1}: the {name} is not finite; "
                f"{self.records.last_good()}.",
                fix="lower the learning rates (--optimizer.*), in another folder, or report the "
                "scene",
            )
        if kind == FAULT_OVERFLOW:
            needed, visible = int(state.fault.needed), int(state.fault.visible)
            host.rooms = capacities.grown(host.rooms, sizes[completed], needed, visible)
            host.overflows += 1
            state = healed(state)
        elif done:
            new_s, known = seconds / done, host.step_s > 0
            host.step_s = (1 - PACE_SHARE) * host.step_s + PACE_SHARE * new_s if known else new_s
        host.step += done
        for _ in range(done):
            host.progress += host.pace
        return state, reports[:completed]

    def _dispatched(
        self, state: FitState, host: HostState
    ) -> tuple[FitState, list[StepReport], list[tuple[int, int]]]:
        """Dispatch a burst; return the state, and the report and image size of every step."""
        progress, reports, sizes = host.progress, [], []
        every, views = self.cfg.train.log_every, self.cfg.train.batch
        end = host.step + min(every - host.step % every, MAX_BURST)
        for step in range(host.step, end, views):
            if schedule.is_over(progress, host.pace):
                break
            if schedule.shrink_at(progress, self.levels) != host.shrink:
                break
            for later in range(1, DECODERS + 1):
                for row in self.views.indices_at(step + later * views, views):
                    self.views.prefetch(row, host.shrink)
            inputs = self._inputs(step, progress, host.pace, host.shrink)
            key = self._key(state, inputs, host, host.shrink)
            state, report = self.programs.get(self.step, key, state, *inputs)(state, *inputs)
            reports.append(report)
            sizes.append(inputs.size)
            for _ in range(views):
                progress = progress + host.pace
        return state, reports, sizes

    def _inputs(self, step: int, progress: float, per_step: float, shrink: int) -> Inputs:
        controls = controls_at(progress, per_step, self.coverage.visible_share, self.cfg)
        return inputs_at(step, controls, shrink, self.views, self.pairs, self.cfg)

    # ---------------------------------------------------------------- between the bursts

    def _densified(self, state: FitState, host: HostState) -> FitState:
        """Return the state after a densification if one is due, else the same state."""
        with self.stopwatch("densification"):
            due = strategies.is_due(self.cfg.densify, host)
            if self.densification is None or not due:
                return state
            host.densified_at = host.progress
            state = strategies.densified(
                self.densification,
                self.step.whole(state),
                host,
                self.cfg,
                self.extent,
                self.slots.limit,
                self.on_message,
            )
            return self.step.spread(state)

    def _save(self, state: FitState, host: HostState) -> None:
        with self.stopwatch("checkpoints"):
            self.records.save(state, host)

    def _allocate(self, gaussians: Gaussians, alive, owner, host: HostState) -> None:
        """Allocate capacities for the image sizes of the levels that are left."""
        host.rooms = capacities.allocate(
            host.rooms,
            self.programs.capacities,
            self.views,
            schedule.shrinks_left(host.progress, self.levels),
            gaussians,
            alive,
            self.slots.most,
            self.cfg.render,
            owner,
        )

    def _expect(self, state: FitState, host: HostState, images: bool = True) -> None:
        """Begin to compile the steps that are left; `state` may consist of shapes.

        With more image sizes than MOST_CANVASES nothing is compiled, as not all may be needed.
        """
        steps = self.views.first_of_sizes(host.step, self.cfg.train.batch)
        if not getattr(self.densification, "slots_stay", True) or len(steps) > MOST_CANVASES:
            return
        left = schedule.shrinks_left(host.progress, self.levels)
        for number, (shrink, step) in enumerate(itertools.product(left, steps)):
            inputs = self._inputs(step, 0.0, host.pace, shrink)
            key = self._key(state, inputs, host, shrink)
            self.programs.expect(self.step, key, state, *inputs, images=images)
            expect = getattr(self.densification, "expect", None)
            if number == 0 and expect is not None:
                expect(self.programs, state)  # needed soon after the first step

    def _key(self, state: FitState, inputs: Inputs, host: HostState, shrink: int) -> Key:
        batch, cfg = inputs.batch, self.cfg
        degree = schedule.highest_degree(shrink, self.levels, cfg.train, cfg.render.sh_degree)
        optional = (batch.measured, batch.alpha, batch.camera.objects, inputs.partner.pairs)
        return Key(
            inputs.size,
            state.params.gaussians.capacity,
            host.rooms[capacities.size_name(inputs.size)],
            degree,
            str(batch.ldr.dtype),
            jax.tree.structure((state, optional)),
        )
