"""`--gaussians auto`: stages of growth, each run without it and with it; the better one is kept."""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

from p2gs_jax.gaussians.population import bucket_for, default_max_gaussians
from p2gs_jax.train import growth
from p2gs_jax.train.burst import MAX_BURST
from p2gs_jax.train.growth import Stage, StageResult
from p2gs_jax.train.host import HostState
from p2gs_jax.train.session import Session
from p2gs_jax.train.state import FitState, count_alive, grow_state
from p2gs_jax.train.strategies.base import RunContext
from p2gs_jax.train.strategies.mcmc import Mcmc
from p2gs_jax.train.validation import make_judge


class Automatic(Mcmc):
    """Mcmc that grows in stages only (`train/growth.py`), judged by held-out training views."""

    slots_stay = False

    def __init__(self, run: RunContext, seeds: int):
        super().__init__(run, seeds)
        self.window = growth.window(run.cfg.densify, run.levels)
        self.judge = make_judge(run.views, run.validation, run.cfg, own_exposures=run.own_exposures)

    def bounds(self, seeds: int) -> tuple[int | None, int]:
        """Return the population at which growth ends in any case; slots follow its stages."""
        default = default_max_gaussians(seeds, self.run.coverage, self.run.cfg.train)
        return growth.upper_bound(seeds, default), seeds

    def begin(self, host: HostState) -> None:
        """Leave the held-out views out of the steps while growth goes on."""
        if host.growth.limit is None:
            self.run.views.leave_out(self.run.validation)

    def update(
        self, state: FitState, host: HostState, session: Session
    ) -> tuple[FitState, HostState]:
        """Run a stage where one is due; relocate between stages and after the last."""
        if self._stage_is_due(host):
            state, host = self._grow(state, host, session)
        if host.progress >= self.window[1]:
            self.end(state, host)
        return super().update(state, host, session)

    def densify(self, state: FitState, host: HostState) -> FitState:
        """Relocate only."""
        return self.relocated(state, host, 0)

    def end(self, state: FitState, host: HostState) -> None:
        """Keep the population from here on, and fit the held-out views as well."""
        if host.growth.limit is not None:
            return
        host.growth.limit = count_alive(state)
        self.run.views.leave_out(())
        self.run.on_message(growth.describe(host.growth, len(self.run.validation)))

    def summary(self, host: HostState) -> dict[str, Any]:
        """Return the history of growth."""
        return growth.summary(host.growth, self.run.validation)

    def _stage_is_due(self, host: HostState) -> bool:
        if host.growth.limit is not None:
            return False
        within = self.window[0] <= host.progress < self.window[1]
        return within and self.is_due(host)

    def _grow(
        self, state: FitState, host: HostState, session: Session
    ) -> tuple[FitState, HostState]:
        """Run a stage twice over the same steps, without growth and with it; keep the better.

        What does not grow runs first. Where time ends within the stage, it is the run: it is never
        behind, and needs no comparison. A checkpoint holds one population: none is written here.
        """
        bound = self.most
        stage = self._next_stage(count_alive(state), bound, host)
        if stage is None:
            self.end(state, host)
            return state, host
        begun = host.step
        # Both have the same slots, and so the same random draws.
        needed = stage.target(stage.events)
        state = grow_state(state, bucket_for(needed, state.params.gaussians.capacity, bound))
        trial_host = copy.deepcopy(host)
        trial = jax.tree.map(jnp.copy, state)  # steps donate their state
        trial = self._run_stage(trial, trial_host, session, stage, grow=False)
        if session.over(trial_host):
            self.run.log.replace_by_trial(begun)
            return trial, trial_host
        # Tile lists that were too short once would be so again.
        host.rooms, host.overflows = dict(trial_host.rooms), trial_host.overflows
        score = self._score(trial)
        grown = self._run_stage(state, host, session, stage, grow=True)
        if session.over(host):
            trial_host.elapsed_s = host.elapsed_s
            self.run.log.replace_by_trial(begun)
            return trial, trial_host
        result = StageResult(
            gaussians=count_alive(grown),
            psnr=self._score(grown),
            before=stage.before,
            without=score,
            progress=round(host.progress, 6),
        )
        host.growth.results.append(result)
        # Tile lists that overflow end bursts early: the two may differ by a few steps.
        kept = grown if result.kept else dataclasses.replace(trial, step=grown.step)
        if host.growth.stalled:
            self.end(kept, host)
        return kept, host

    def _run_stage(
        self, state: FitState, host: HostState, session: Session, stage: Stage, *, grow: bool
    ) -> FitState:
        """Run the densifications of a stage and the steps after each; the pace stays.

        It ends early where the time does, or the window of growth.

        Args:
            state: to start from; donated.
            host: counters; changed.
            session: the clock.
            stage: its densifications.
            grow: otherwise Gaussians are only relocated, and the steps are logged as a trial.
        """
        for done in range(1, stage.events + 1):
            host.densified_at = host.progress
            with self.run.clock("densification"):
                state = self.relocated(state, host, stage.target(done) if grow else 0)
            while host.progress - host.densified_at < self.interval(host):
                state, _ = self.run.take_burst(state, host, session, trial=not grow)
                if session.over(host) or host.progress >= self.window[1]:
                    return state
        return state

    def _next_stage(self, population: int, bound: int, host: HostState) -> Stage | None:
        """Return the next stage, or None where there is no room or time for one."""
        left = (self.window[1] - host.progress) / host.pace
        # Strategies are asked after every burst only.
        burst = min(self.run.cfg.train.log_every, MAX_BURST)
        interval = math.ceil(self.interval(host) / host.pace / burst - 1e-6) * burst
        return growth.plan_stage(population, bound, left, interval)

    def _score(self, state: FitState) -> float:
        """Return the mean PSNR of the held-out views, dB."""
        with self.run.clock("densification"):
            return self.judge(state.params, state.population)
