"""The host loop: bursts of jitted steps, and between them everything that changes shapes.

Within a burst the host only dispatches. After it the host reads the fault flag and the reports,
logs, lets the strategy densify, replans the pace and checkpoints. All decisions follow from the
seed and the step number (and, under a time budget, from paces that the checkpoint remembers), so a
resumed run takes the same path as an uninterrupted one: bit for bit on a CPU, and on GPUs as far as
their sums repeat (`RenderConfig.deterministic`).
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
from p2gs_jax.train import room, schedule, strategies
from p2gs_jax.train.data_parallel import VIEWS, ParallelStep
from p2gs_jax.train.divided import DividedStep
from p2gs_jax.train.exposure_loss import ColorPairs
from p2gs_jax.train.inputs import Inputs, TrainingViews, controls_at, inputs_at
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.records import Records, pause_between, record_of
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

NEARLY_DONE = 0.99
MAX_BURST = 50
# Share of a new pace in its running estimate.
PACE_SHARE = 0.3


@dataclass(frozen=True)
class TrainResult:
    """The end of a run: state, counters, and the seconds of this session.

    They are, by name: compiling (waited for), steps, densification, checkpoints.
    """

    state: FitState
    host: HostState
    seconds: dict[str, float]


@dataclass(eq=False)
class Trainer:
    """Runs one fit from its initial parameters to its final ones.

    A formation of yours is passed as `params.appearance` of `run`.
    """

    cfg: FitConfig
    views: TrainingViews
    extent: float  # scene extent, scene units
    # corresponding observations, where the relative-exposure loss compares photographs
    pairs: ColorPairs | None
    coverage: Coverage  # how much of the scene the views show
    run_dir: Path  # where `log.jsonl` and `checkpoints/` go
    programs: StepPrograms  # compiled steps, some of them perhaps begun
    decided: Decisions  # what the scene settled; a resumed run must have settled the same
    on_log: Callable[[LogRecord], None] = lambda record: None
    on_message: Callable[[str], None] = lambda text: None  # told what the user must know
    mesh: Mesh | None = None  # the devices of a step, from `mesh_of`
    # loss terms to add to those of `cfg`, or to replace; None takes one away
    terms: Mapping[str, LossTerm | None] | None = None
    strategy: Strategy | None = None  # how the population changes; None: as `cfg` says
    now: Callable[[], float] = time.monotonic  # seconds on a clock that never goes back
    store: CheckpointStore | None = None  # of checkpoints; None: `checkpoints/`

    def __post_init__(self):
        cfg, views = self.cfg, self.views
        sizes = [views.camera(i, 1) for i in range(len(views))]
        width, height = min(c.width for c in sizes), min(c.height for c in sizes)
        self.levels = schedule.levels(cfg.train, width, height)
        self.stopwatch = Stopwatch()
        store = self.store or CheckpointStore(self.run_dir / "checkpoints")
        given = (self.run_dir, store, cfg, self.decided, self.on_log, self.on_message)
        self.records = Records(*given)
        self.asked = interrupts.Held()
        self.optimizer = make_optimizer(cfg)
        chosen = strategies.make_strategy(cfg, self.coverage, self.levels)
        self.densification = self.strategy or chosen
        noise = getattr(self.densification, "noise", None)
        given = (cfg, self.optimizer, self.extent, noise, self.terms or {})
        kinds = {VIEWS: ParallelStep, CORES: DividedStep}
        self.step = Step(*given)
        if self.mesh is not None:
            self.step = kinds[self.mesh.axis_names[0]](*given, mesh=self.mesh)

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
        """Optimise until the run is complete, from initial parameters or the newest checkpoint.

        `alive` says which Gaussians exist, `owner` which moving object each belongs to. `spent_s`
        are the seconds of a time budget that are gone, `finish_s` those to leave for what follows,
        on an unloaded machine.

        Raises:
            DivergenceError: a loss term or gradient is not finite.
            UserError: no Gaussian is left, or checkpoints cannot be continued from.
            Interrupted: a signal asked for the end; a checkpoint is written first.
        """
        self.slots = strategies.started(self.densification, int(np.sum(np.asarray(alive))))
        state = initial_state(params, alive, self.optimizer, self.slots.slots, owner)
        train = self.cfg.train
        planned = float(train.budget_s or train.steps)
        host = HostState(planned=planned, pace=1.0 / max(train.steps, 1))
        state, host = self.records.begin(state, planned, resume) or (state, host)
        # Planned for longer, a run has room for more Gaussians.
        state = grow_state(state, self.step.slots(self.slots.slots))
        # On GPUs the host decides the pace of short steps, which tells nothing of evaluation.
        here = jax.default_backend() == "cpu"
        full_step_s = step_seconds(self.coverage.pixels) if here else math.inf
        seconds = {"spent_s": spent_s, "finish_s": finish_s, "full_step_s": full_step_s}
        clock = RunClock(self.cfg.train, host, **seconds, now=self.now)
        population = state.population
        self._allocate(state.params.gaussians, population.alive, population.owner, host)
        state = self.step.spread(state)
        self._expect(state, host)
        with interrupts.held() as self.asked:
            state = self._loop(state, host, clock)
            state = self.step.whole(state)
            self._save(state, host)
        seconds = {"compiling": self.programs.waited_s, **self.stopwatch.seconds}
        return TrainResult(state, host, seconds)

    def expect(self, params: Params, owner, images: bool) -> None:
        """Begin to compile the steps of a run before its colours and exposures are known.

        `params` are as the run will have them, as far as they are known; `images`: so is the tone
        curve.
        """
        seeds = params.gaussians.capacity
        self.slots = strategies.started(self.densification, seeds)
        alive, host = np.ones(seeds, bool), HostState(rooms=dict(self.programs.rooms))
        self._allocate(params.gaussians, alive, owner, host)
        self.programs.rooms = dict(host.rooms)
        slots = self.step.slots(self.slots.slots)
        start = functools.partial(initial_state, optimizer=self.optimizer, slots=slots)
        self._expect(jax.eval_shape(start, params, alive, owner=owner), host, images)

    # ------------------------------------------------------------------ bursts of steps

    def _loop(self, state: FitState, host: HostState, clock: RunClock) -> FitState:
        """Take bursts until the run is complete, or its time over."""
        every_s = self.cfg.train.checkpoint_every_s
        saved, pause = host.elapsed_s, every_s
        while not schedule.is_over(host.progress, host.pace):
            state, reports = self._take_burst(state, host)
            clock.tick(host)
            if reports:
                alive, left_s = alive_in(state.population), clock.left(host, self.levels)
                self.records.log(record_of(reports, host, alive, left_s))
                # From here on a signal waits for the next place to continue from.
                self.asked.begin()
                state = self._densified(state, host)
            clock.replan(host)
            if clock.over(host):
                if host.progress < NEARLY_DONE:
                    self.on_message(
                        f"The budget ended the run at {host.progress:.0%} of its schedule: "
                        "`fit --resume` with a longer --budget goes on from here."
                    )
                break
            asked = self.asked.arrived
            if asked is not None or host.elapsed_s - saved > pause:
                begun = host.elapsed_s
                self._save(self.step.whole(state), host)
                clock.tick(host)
                saved = host.elapsed_s
                pause = pause_between(every_s, saved - begun)
            if asked is not None:
                self.on_message(
                    f"{interrupts.name_of(asked)}: the run stops after step {host.step} "
                    f"({host.progress:.0%}), where a checkpoint is written."
                )
                self.asked.deliver()
        return state

    def _take_burst(self, state: FitState, host: HostState) -> tuple[FitState, list[StepReport]]:
        """Dispatch steps up to the next line of the log, then read how they went.

        Where a view finds no room, the steps that the device refused do not count, and the room
        grows. The state is donated, the counters of `host` change. A report of every step that was
        taken is returned.

        Raises:
            DivergenceError: a loss term or gradient is not finite.
        """
        shrink = schedule.shrink_at(host.progress, self.levels)
        if shrink != host.shrink:
            host.shrink, host.step_s = shrink, 0.0
            return_freed_memory()
        begin, waited = self.now(), self.programs.waited_s
        state, reports, sizes = self._dispatched(state, host)
        kind = int(state.fault.kind)
        done = int(state.step) - host.step
        taken = done // self.cfg.train.batch
        seconds = self.now() - begin - (self.programs.waited_s - waited)
        self.stopwatch.add("steps", seconds)
        if kind == FAULT_NONFINITE:
            name = finite_names(reports[taken].terms, state.params)[int(state.fault.term)]
            raise DivergenceError(
                f"Step {host.step + done + 1}: the {name} is not finite; "
                f"{self.records.last_good()}.",
                fix="lower the learning rates (--optimizer.*), in another folder, or report the "
                "scene",
            )
        if kind == FAULT_OVERFLOW:
            needed, visible = int(state.fault.needed), int(state.fault.visible)
            host.rooms = room.grown(host.rooms, sizes[taken], needed, visible)
            host.overflows += 1
            state = healed(state)
        elif done:
            pace, known = seconds / done, host.step_s > 0
            host.step_s = (1 - PACE_SHARE) * host.step_s + PACE_SHARE * pace if known else pace
        host.step += done
        for _ in range(done):
            host.progress += host.pace
        return state, reports[:taken]

    def _dispatched(
        self, state: FitState, host: HostState
    ) -> tuple[FitState, list[StepReport], list[tuple[int, int]]]:
        """Dispatch the steps of a burst; return the state, and report and image size of each."""
        progress, reports, sizes = host.progress, [], []
        every, views = self.cfg.train.log_every, self.cfg.train.batch
        end = host.step + min(every - host.step % every, MAX_BURST)
        for step in range(host.step, end, views):
            if schedule.is_over(progress, host.pace):
                break
            if schedule.shrink_at(progress, self.levels) != host.shrink:
                break
            for row in self.views.indices_at(step + views, views):
                self.views.prefetch(row, host.shrink)
            inputs = self._inputs(step, progress, host.pace, host.shrink)
            key = self._key(state, inputs, host, host.shrink)
            state, report = self.programs.get(self.step, key, state, *inputs)(state, *inputs)
            reports.append(report)
            sizes.append(inputs.size)
            for _ in range(views):
                progress = progress + host.pace
        return state, reports, sizes

    def _inputs(self, step: int, progress: float, pace: float, shrink: int) -> Inputs:
        controls = controls_at(progress, pace, self.coverage.shown, self.cfg)
        return inputs_at(step, controls, shrink, self.views, self.pairs, self.cfg)

    # ---------------------------------------------------------------- between the bursts

    def _densified(self, state: FitState, host: HostState) -> FitState:
        """Return the state with another population, where it is time to change it."""
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
        """Make room for the image sizes to come."""
        host.rooms = room.allocate(
            host.rooms,
            self.programs.rooms,
            self.views,
            schedule.shrinks_left(host.progress, self.levels),
            gaussians,
            alive,
            self.slots.most,
            self.cfg.render,
            owner,
        )

    def _expect(self, state: FitState, host: HostState, images: bool = True) -> None:
        """Begin to compile what is known of the steps to come; `state` may be its shapes.

        Images of more sizes than MOST_CANVASES are left out: not all of them may come.
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
                expect(self.programs, state)  # wanted soon after the first step

    def _key(self, state: FitState, inputs: Inputs, host: HostState, shrink: int) -> Key:
        """Return what a step of a level is compiled for."""
        batch, cfg = inputs.batch, self.cfg
        degree = schedule.highest_degree(shrink, self.levels, cfg.train, cfg.render.sh_degree)
        comes_with = (batch.measured, batch.alpha, batch.camera.objects, inputs.partner.pairs)
        return Key(
            inputs.size,
            state.params.gaussians.capacity,
            host.rooms[room.size_name(inputs.size)],
            degree,
            str(batch.ldr.dtype),
            jax.tree.structure((state, comes_with)),
        )
