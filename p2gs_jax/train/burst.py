"""A burst: steps that are only dispatched; then the host reads fault flag and reports, once."""

from __future__ import annotations

import time

from p2gs_jax.config import TrainConfig
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.errors import DivergenceError
from p2gs_jax.train import room, schedule
from p2gs_jax.train.advance import StepReport, finite_names
from p2gs_jax.train.checkpoints import RunCheckpoints
from p2gs_jax.train.data_parallel import Spread
from p2gs_jax.train.host import HostState
from p2gs_jax.train.inputs import InputSource
from p2gs_jax.train.level_programs import LevelPrograms
from p2gs_jax.train.schedule import Levels
from p2gs_jax.train.state import FAULT_NONFINITE, FAULT_OVERFLOW, FitState

MAX_BURST = 50
# Share of a new pace in its running estimate.
PACE_SHARE = 0.3


class Bursts:
    """Takes steps, a burst at a time.

    Args:
        train: length of a burst, schedules.
        levels: of the schedule.
        source: of inputs.
        steps: compiled steps.
        spread: how the state lies on the devices.
        checkpoints: named where a run diverges.
        clock: receives the seconds of steps.
    """

    def __init__(
        self,
        train: TrainConfig,
        levels: Levels,
        source: InputSource,
        steps: LevelPrograms,
        spread: Spread,
        checkpoints: RunCheckpoints,
        clock: Stopwatch,
    ):
        self.train, self.levels, self.source, self.steps = train, levels, source, steps
        self.spread, self.checkpoints, self.clock = spread, checkpoints, clock

    def take(self, state: FitState, host: HostState) -> tuple[FitState, list[StepReport]]:
        """Dispatch steps up to the next line of the log, then read how they went.

        Where a view finds no room, the steps that the device refused do not count, and the room
        grows.

        Args:
            state: to start from; donated.
            host: counters; changed.

        Returns:
            The state, and a report of every step that was taken.

        Raises:
            DivergenceError: a loss term or gradient is not finite.
        """
        shrink = schedule.shrink_at(host.progress, self.levels)
        if shrink != host.shrink:
            host.shrink, host.step_s = shrink, 0.0
            return_freed_memory()
        begin, waited = time.monotonic(), self.steps.programs.waited_s
        state, reports, sizes = self._dispatched(state, host)
        kind = int(state.fault.kind)
        done = int(state.step) - host.step
        taken = done // self.train.batch
        seconds = time.monotonic() - begin - (self.steps.programs.waited_s - waited)
        self.clock.add("steps", seconds)
        if kind == FAULT_NONFINITE:
            self._diverged(state, host.step + done, reports[taken])
        if kind == FAULT_OVERFLOW:
            needed, visible = int(state.fault.needed), int(state.fault.visible)
            host.rooms = room.grown(host.rooms, sizes[taken], needed, visible)
            host.overflows += 1
            state = self.spread.healed(state)
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
        every, views = self.train.log_every, self.train.batch
        end = host.step + min(every - host.step % every, MAX_BURST)
        for step in range(host.step, end, views):
            if schedule.is_over(progress, host.pace):
                break
            if schedule.shrink_at(progress, self.levels) != host.shrink:
                break
            self.source.prefetch(step + views, host.shrink)
            inputs = self.source.at(step, progress, host.pace, host.shrink)
            state, report = self.steps.get(state, inputs, host)(state, *inputs)
            reports.append(report)
            sizes.append(inputs.size)
            for _ in range(views):
                progress = progress + host.pace
        return state, reports, sizes

    def _diverged(self, state: FitState, step: int, report: StepReport) -> None:
        name = finite_names(report.terms, state.params)[int(state.fault.term)]
        raise DivergenceError(
            f"Step {step + 1}: the {name} is not finite; {self.checkpoints.last_good()}.",
            fix="lower the learning rates (--optimizer.*) or report the scene; "
            "--resume continues from the last good checkpoint",
        )
