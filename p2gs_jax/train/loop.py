"""The host loop: bursts of jitted steps, and between them everything that changes shapes.

Within a burst the host only dispatches. After it the host reads the fault flag and the reports,
densifies, logs, replans the pace and checkpoints. All decisions follow from the seed and the step
number (and, under a time budget, from paces that the checkpoint remembers), so a resumed run takes
the same path as an uninterrupted one: bit for bit on a CPU, and on GPUs as far as their sums repeat
(`RenderConfig.deterministic`).
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import append_jsonl, read_jsonl, write_text
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.progress import LogRecord
from p2gs_jax.core.streams import Stream, densification_key, generator
from p2gs_jax.errors import DivergenceError, UserError
from p2gs_jax.gaussians import adaptive, mcmc
from p2gs_jax.gaussians.population import (
    STEP_SECONDS_PER_PIXEL,
    Coverage,
    bucket_for,
    default_max_gaussians,
)
from p2gs_jax.losses.relative_exposure import ColorPairs
from p2gs_jax.losses.total import OBSERVED_FORMS, SECOND_RENDER_FORMS, Partner
from p2gs_jax.render.capacity import Room
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import KEY, Decisions
from p2gs_jax.train import growth, schedule
from p2gs_jax.train.demand import demand
from p2gs_jax.train.growth import Stage, StageResult
from p2gs_jax.train.host import HostState
from p2gs_jax.train.optimizer import make_optimizer, zero_moments, zero_opacity_moments
from p2gs_jax.train.programs import Key, StepPrograms
from p2gs_jax.train.room import room_for
from p2gs_jax.train.schedule import Pace
from p2gs_jax.train.session import Session
from p2gs_jax.train.state import (
    FAULT_NONFINITE,
    FAULT_OVERFLOW,
    Fault,
    FitState,
    grow_state,
    initial_state,
    replace_gaussians,
)
from p2gs_jax.train.step import Controls, StepReport, finite_names, make_step
from p2gs_jax.train.validation import make_judge
from p2gs_jax.train.views import TrainingViews
from p2gs_jax.types import Batch, Camera, Gaussians, Params

PAIRS_PER_STEP = 4096
MAX_BURST = 50
NEARLY_DONE = 0.99
SLOTS = 1024
# Steps at full size cost about twice the present ones, at a coarse level.
FULL_SIZE_COST = 2.0


@dataclass(frozen=True)
class TrainResult:
    """The end of a run.

    Attributes:
        state: parameters and population.
        host: counters.
        max_gaussians: bound on the population.
        growth: the history of automatic growth, as JSON values; None where it was not asked for.
        seconds: of this session, by name: compiling (waited for), steps, densification,
            checkpoints.
    """

    state: FitState
    host: HostState
    max_gaussians: int
    growth: dict | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)


class Trainer:
    """Runs one fit from its initial parameters to its final ones.

    Args:
        cfg: everything.
        views: the training views.
        extent: scene extent, scene units.
        pairs: corresponding observations, for the relative-exposure readings that need them.
        coverage: how much of the scene the views show.
        run_dir: where `log.jsonl`, `growth.jsonl` and `checkpoints/` go.
        programs: compiled steps, some of them perhaps begun.
        decided: what the scene settled; a run that is resumed must have settled the same.
        on_log: called with every log record.
        on_message: called with everything the user must know.
        validation: training views that automatic growth is judged by.
        own_exposures: their exposures come from tracks, so they may be judged under these.
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
        validation: Sequence[int] = (),
        own_exposures: bool = False,
    ):
        self.cfg, self.views, self.extent, self.pairs = cfg, views, extent, pairs
        self.coverage = coverage
        self.run_dir, self.on_log, self.on_message = run_dir, on_log, on_message
        self.decided = decided
        self.optimizer = make_optimizer(cfg)
        self.step = make_step(cfg, self.optimizer, extent)
        self.programs = programs
        self._rng = jax.jit(functools.partial(densification_key, cfg.train.seed))
        self._alive = jax.jit(jnp.sum)
        self.clock = Stopwatch()
        self.checkpoints = CheckpointStore(run_dir / "checkpoints")
        self.log_path = run_dir / "log.jsonl"
        # What automatic growth compares with takes the same steps, so it has a log of its own.
        self.trial_path = run_dir / "growth.jsonl"
        sizes = [views.camera(i, 1) for i in range(len(views))]
        self.levels = schedule.levels(
            cfg.train, min(c.width for c in sizes), min(c.height for c in sizes)
        )
        self.sh_degree = cfg.render.sh_degree
        self._densify_adaptive = jax.jit(adaptive.apply)
        self._propose = jax.jit(functools.partial(adaptive.propose, cfg=cfg.densify))
        self._relocate = jax.jit(functools.partial(_relocate, cfg=cfg))
        self._zero_moments = jax.jit(zero_moments)
        self.auto = cfg.densify.max_gaussians == "auto"
        if self.auto:
            self.validation = validation
            self.growth_window = growth.window(cfg.densify, self.levels)
            self.judge = make_judge(views, self.validation, cfg, own_exposures=own_exposures)

    # -------------------------------------------------------------- starting and resuming

    def _restore(self, template: FitState) -> tuple[FitState, HostState] | None:
        found = self.checkpoints.restore_latest(
            lambda meta: jax.eval_shape(lambda: grow_state(template, meta["gaussian_capacity"])),
            self.on_message,
        )
        if found is None:
            return None
        self.decided.require_same(found[1].get(KEY), self.checkpoints.folder)
        state = jax.tree.map(jnp.asarray, found[0])
        host = HostState.from_dict(found[1]["host"])
        self.checkpoints.discard_after(host.step)
        for path in (self.log_path, self.trial_path):
            if path.exists():
                kept = [line for line in read_jsonl(path) if line["step"] <= host.step]
                _write_lines(path, kept)
        self.on_message(f"Resuming after step {host.step} ({host.progress:.0%}).")
        if not _repeats(self.cfg):
            self.on_message(
                "Sums on this device come in no fixed order: the rest of the run is as good as "
                "without the interruption, but not the same bit for bit "
                "(--render.deterministic from the start fixes the order of the renderer's)."
            )
        return state, host

    def _save(self, state: FitState, host: HostState) -> None:
        meta = {
            "host": dataclasses.asdict(host),
            "gaussian_capacity": state.params.gaussians.capacity,
            KEY: self.decided.to_dict(),
        }
        self.checkpoints.save(host.step, state, meta)

    # -------------------------------------------------------------- the run

    def run(
        self,
        params: Params,
        alive,
        *,
        resume: bool = False,
        spent_s: float = 0.0,
        finish_s: float = 0.0,
    ) -> TrainResult:
        """Optimise until the run is complete.

        Args:
            params: initial parameters.
            alive: which Gaussians exist.
            resume: continue from the newest checkpoint, if there is one.
            spent_s: seconds of a time budget that are gone.
            finish_s: seconds of it to leave for what follows, on an unloaded machine.

        Raises:
            DivergenceError: a loss term or gradient is not finite.
        """
        train = self.cfg.train
        limit, slots = self._slots(int(np.sum(np.asarray(alive))))
        state = initial_state(params, alive, self.optimizer, slots)
        pace = Pace.from_config(train, spent_s + finish_s)
        host = HostState(pace=pace.per_step)
        if resume and (restored := self._restore(state)) is not None:
            state, host = restored
            pace = dataclasses.replace(pace, per_step=host.pace)
        else:
            for path in (self.log_path, self.trial_path):
                path.unlink(missing_ok=True)
        if self.auto and host.growth.limit is None:
            self.views.leave_out(self.validation)

        full_step_s = STEP_SECONDS_PER_PIXEL * self.coverage.pixels
        session = Session(pace, host, finish_s=finish_s, full_step_s=full_step_s)
        last_save = time.monotonic()
        most = max(limit or 0, slots)
        self._make_room(state.params.gaussians, state.population.alive, host, most)
        self._expect(state, host)
        while host.progress < 1.0 - 0.5 * host.pace:
            state, stepped = self._advance(state, host, session)
            if stepped and self._stage_due(host):
                state, host = self._grow(state, host, limit or 0, session)
            if stepped:
                with self.clock("densification"):
                    state = self._maybe_densify(state, host, limit)
            session.replan(host)
            if session.over(host):
                if host.progress < NEARLY_DONE:
                    self.on_message(
                        f"The budget ended the run at {host.progress:.0%} of its schedule: fit "
                        "again with a longer --budget; what was compiled now is kept."
                    )
                break
            if time.monotonic() - last_save > train.checkpoint_every_s:
                with self.clock("checkpoints"):
                    self._save(state, host)
                last_save = time.monotonic()
        if self.auto:
            self._end_growth(state, host)
        with self.clock("checkpoints"):
            self._save(state, host)
        summary = growth.summary(host.growth, self.validation) if self.auto else None
        most = limit or state.params.gaussians.capacity
        return TrainResult(state, host, most, summary, self._seconds())

    def _seconds(self) -> dict[str, float]:
        """Return where the time went, by name."""
        return {"compiling": self.programs.waited_s, **self.clock.seconds}

    def expect(self, params: Params, images: bool) -> None:
        """Begin to compile the steps of a run before its colours and exposures are known.

        Args:
            params: as the run will have them, as far as they are known.
            images: the tone curve is known.
        """
        seeds = params.gaussians.capacity
        limit, slots = self._slots(seeds)
        alive, host = np.ones(seeds, bool), HostState(rooms=dict(self.programs.rooms))
        self._make_room(params.gaussians, alive, host, max(limit or 0, slots))
        self.programs.rooms = dict(host.rooms)
        start = functools.partial(initial_state, optimizer=self.optimizer, slots=slots)
        self._expect(jax.eval_shape(start, params, alive), host, images)

    def _slots(self, seeds: int) -> tuple[int | None, int]:
        """Return the bound on the population, or None, and room for it to begin with."""
        limit = self._limit(seeds)
        if self.cfg.densify.method != "mcmc" or self.auto:
            return limit, seeds
        # Rounded: a seed more or less, known late, should not be another program.
        return limit, -(-max(limit or 0, seeds) // SLOTS) * SLOTS

    def _limit(self, seeds: int) -> int | None:
        """Return the bound on the population; None: there is none."""
        d = self.cfg.densify
        default = default_max_gaussians(seeds, self.coverage, self.cfg.train)
        if d.max_gaussians == "auto":
            return growth.upper_bound(seeds, default)
        if d.method != "mcmc":
            return d.max_gaussians
        return max(default if d.max_gaussians is None else d.max_gaussians, seeds)

    def _advance(
        self, state: FitState, host: HostState, session: Session, *, trial: bool = False
    ) -> tuple[FitState, bool]:
        """Take a burst of steps and log it; return the state and whether there were any.

        Args:
            state: to start from; it is given away.
            host: counters; changed.
            session: the clock.
            trial: the run is one that automatic growth compares with.
        """
        shrink = schedule.shrink_at(host.progress, self.levels)
        state, reports = self._burst(state, host)
        session.tick(host)
        if reports:
            self._log(reports, state, host, shrink, trial)
        return state, bool(reports)

    def _burst(
        self, state: FitState, host: HostState
    ) -> tuple[FitState, list[tuple[int, float, StepReport]]]:
        """Dispatch steps up to the next point where the host must look, then look.

        Where a view finds no room, the steps that the device refused are taken back and the room
        grows.
        """
        shrink = schedule.shrink_at(host.progress, self.levels)
        if shrink != host.shrink:
            host.shrink, host.step_s = shrink, 0.0
        length = self.cfg.train.log_every - host.step % self.cfg.train.log_every
        length = max(1, min(length, MAX_BURST))
        reports: list[tuple[int, float, StepReport]] = []
        progress = host.progress
        begin, waited = time.monotonic(), self.programs.waited_s
        sizes = []
        for k in range(length):
            if progress >= 1.0 - 0.5 * host.pace:
                break
            if schedule.shrink_at(progress, self.levels) != shrink:
                break
            step = host.step + k
            index = self.views.index_at(step)
            self.views.prefetch(self.views.index_at(step + 1), shrink)
            batch = self.views.batch(index, shrink)
            size = (batch.camera.width, batch.camera.height)
            sizes.append(size)
            partner = self._partner(step, shrink)
            arguments = (
                state,
                batch,
                partner,
                on_host(
                    Controls,
                    np.float32(progress),
                    np.int32(schedule.sh_degree_at(progress, self.cfg.train, self.sh_degree)),
                ),
            )
            key = self._program(state, batch, partner, host, shrink)
            state, report = self.programs.get(self.step, key, *arguments)(*arguments)
            reports.append((step, progress, report))
            progress = progress + host.pace
        kind = int(state.fault.kind)
        done = int(state.step) - host.step
        seconds = time.monotonic() - begin - (self.programs.waited_s - waited)
        self.clock.add("steps", seconds)
        if kind == FAULT_NONFINITE:
            self._diverged(state, host.step + done, reports[done][2])
        if kind == FAULT_OVERFLOW:
            room = self._room(host, sizes[done])
            grown = room.grown(int(state.fault.needed), int(state.fault.visible))
            host.rooms[_name(sizes[done])] = grown
            self._share_visible(host)
            host.overflows += 1
            state = dataclasses.replace(state, fault=Fault.none())
        elif done:
            per_step = seconds / done
            known = host.step_s > 0
            host.step_s = 0.7 * host.step_s + 0.3 * per_step if known else per_step
        reports = reports[:done]
        host.step += done
        for _ in range(done):
            host.progress += host.pace
        return state, reports

    # -------------------------------------------------------------- room and programs

    def _room(self, host: HostState, size: tuple[int, int]) -> Room:
        return host.rooms[_name(size)]

    def _share_visible(self, host: HostState) -> None:
        """Give all image sizes the same room for Gaussians: what is done per Gaussian is shared."""
        most = max((room.visible for room in host.rooms.values()), default=0)
        host.rooms = {name: room._replace(visible=most) for name, room in host.rooms.items()}

    def _program(
        self, state: FitState, batch: Batch, partner: Partner, host: HostState, shrink: int
    ) -> Key:
        size = (batch.camera.width, batch.camera.height)
        room, degree = self._room(host, size), self._degree(shrink)
        pixels = tuple(str(b.ldr.dtype) for b in (batch, partner.batch) if b is not None)
        return Key(size, state.params.gaussians.capacity, room, degree, pixels)

    def _degree(self, shrink: int) -> int:
        """Return the highest spherical-harmonics degree that a level of the schedule uses."""
        end = next((end for end, factor in self.levels if factor == shrink), 1.0)
        return schedule.sh_degree_at(end, self.cfg.train, self.sh_degree)

    def _make_room(self, gaussians: Gaussians, alive, host: HostState, most: int) -> None:
        """Estimate the room of every image size to come, for a population of at most so many."""
        gaussians, alive = jax.tree.map(np.asarray, gaussians), np.asarray(alive)
        for end, shrink in self.levels:
            if end <= host.progress:
                continue
            for size, cameras in self._sizes(shrink).items():
                name = _name(size)
                if name in host.rooms:
                    continue
                room = room_for(gaussians, alive, cameras, most, self.cfg.render)
                begun = self.programs.rooms.get(name, room)
                host.rooms[name] = begun if begun.holds(room) else room
        self._share_visible(host)

    def _sizes(self, shrink: int) -> dict[tuple[int, int], list[Camera]]:
        """Return the cameras of a level by the size of their images."""
        cameras: dict[tuple[int, int], list[Camera]] = {}
        for index in range(len(self.views)):
            camera = self.views.camera(index, shrink)
            cameras.setdefault((camera.width, camera.height), []).append(camera)
        return cameras

    def _expect(self, state: FitState, host: HostState, images: bool = True) -> None:
        """Begin to compile what is known of the steps to come, given a state or its shapes."""
        if self.auto or self.cfg.densify.method == "adaptive":
            return  # the population's slots are not known beforehand
        ahead, step = False, host.step
        for end, shrink in self.levels:
            if end <= host.progress or len(self._sizes(shrink)) > 1:
                continue  # over, or it is not known which size comes first
            batch = self.views.batch(self.views.index_at(step), shrink)
            partner = self._partner(step, shrink)
            key = self._program(state, batch, partner, host, shrink)
            controls = on_host(Controls, np.float32(0), np.int32(0))
            self.programs.expect(self.step, key, state, batch, partner, controls, images=images)
            if not ahead and self.cfg.densify.method == "mcmc":
                ahead = True  # wanted soon after the first step
                self._relocate = self.programs.ahead(
                    ("relocate", self.cfg.densify, self.cfg.optimizer.b2, key.slots),
                    self._relocate,
                    jax.eval_shape(self._rng, np.int32(0)),
                    state.params.gaussians,
                    state.population,
                    state.opt_state.gaussians[0],
                    np.int32(0),
                )

    def _partner(self, step: int, shrink: int) -> Partner:
        """Return the second view of the relative-exposure loss, as much of it as is needed."""
        relative = self.cfg.loss.relative_exposure
        if relative.weight is None:
            return on_host(Partner, np.int32(0))
        other = self.views.partner_at(step)
        camera, batch, pairs = None, None, None
        if relative.form in SECOND_RENDER_FORMS:
            camera = self.views.camera(other, shrink)
        elif relative.form in OBSERVED_FORMS and relative.correspondence == "depth":
            batch = self.views.batch(other, shrink)
        elif relative.form in OBSERVED_FORMS and self.pairs is not None:
            count = self.pairs.views_i.shape[0]
            rng = generator(self.cfg.train.seed, Stream.STEP_PAIRS, step)
            pick = rng.integers(0, count, min(PAIRS_PER_STEP, count))
            pairs = jax.tree.map(lambda a: np.asarray(a)[pick], self.pairs)
        return on_host(Partner, np.int32(other), camera, batch, pairs)

    def _diverged(self, state: FitState, step: int, report: StepReport) -> None:
        names = finite_names(report.terms)
        name = names[int(state.fault.term)]
        latest = self.checkpoints.latest_step()
        where = (
            "no checkpoint was written yet"
            if latest is None
            else f"the last good checkpoint is step {latest} in {self.checkpoints.folder}"
        )
        raise DivergenceError(
            f"Step {step + 1}: the {name} is not finite; {where}.",
            fix="lower the learning rates (--optimizer.*) or report the scene; "
            "--resume continues from the last good checkpoint",
        )

    # -------------------------------------------------------------- between bursts

    def _log(self, reports, state: FitState, host: HostState, shrink: int, trial: bool) -> None:
        last = reports[-1][2]
        record = LogRecord(
            step=host.step,
            progress=round(host.progress, 6),
            loss=_mean(r.loss for _, _, r in reports),
            psnr=_mean(r.psnr for _, _, r in reports),
            gaussians=self._count(state),
            shrink=shrink,
            entries=int(last.entries),
            seconds=round(host.elapsed_s, 3),
            step_seconds=round(host.step_s, 5),
            terms={k: _mean(r.terms[k] for _, _, r in reports) for k in last.terms},
            trial=trial,
        )
        line = dataclasses.asdict(record)
        del line["trial"]
        append_jsonl(self.trial_path if trial else self.log_path, line)
        self.on_log(record)

    def _maybe_densify(self, state: FitState, host: HostState, limit: int | None) -> FitState:
        d = self.cfg.densify
        if self.auto and host.progress >= self.growth_window[1]:
            self._end_growth(state, host)
        if d.method is None or not d.start <= host.progress < d.stop:
            return state
        if host.progress - host.densified_at < self._interval(host):
            return state
        if self.auto:
            wanted = 0  # it grows in stages only
        elif d.method == "mcmc":
            wanted = self._target(state, host, limit)
        else:
            wanted = None
        host.densified_at = host.progress
        if wanted is None:
            return self._adaptive_step(state, host, limit)
        return self._relocate_step(state, host, wanted)

    def _interval(self, host: HostState) -> float:
        d = self.cfg.densify
        return max(d.every, d.min_every_steps * host.pace)

    def _key(self, host: HostState):
        return self._rng(np.int32(host.step))

    def _target(self, state: FitState, host: HostState, limit: int | None) -> int:
        """Return the population after the next relocation."""
        alive = self._count(state)
        limit = self._affordable(alive, host, limit)
        room = max((limit or alive) / max(alive, 1), 1.0)
        # A short run has few events: grow so that the limit is reached at the last of them.
        events = (self.cfg.densify.stop - host.progress) / self._interval(host)
        factor = max(self.cfg.densify.growth, room ** (1 / max(events, 1.0)))
        return min(math.ceil(alive * factor), limit or alive)

    def _affordable(self, alive: int, host: HostState, limit: int | None) -> int | None:
        """Return the bound on the population that the pace of this machine allows.

        Where the bound was chosen for a time budget, it was chosen for an unloaded machine.
        """
        chosen = self.cfg.densify.max_gaussians is None and self.cfg.train.budget_s is not None
        if not chosen or limit is None or host.step_s <= 0:
            return limit
        left = (1.0 - host.progress) / host.pace
        later = any(end > host.progress and factor < host.shrink for end, factor in self.levels)
        steps = host.step + (left / FULL_SIZE_COST if later else left)
        return max(alive, min(limit, self.coverage.gaussians(steps)))

    def _relocate_step(self, state: FitState, host: HostState, wanted: int) -> FitState:
        births = max(wanted - self._count(state), 0)
        outcome = self._relocate(
            self._key(host),
            state.params.gaussians,
            state.population,
            state.opt_state.gaussians[0],
            np.int32(births),
        )
        return self._settle(state, outcome, host)

    # -------------------------------------------------------------- automatic growth

    def _stage_due(self, host: HostState) -> bool:
        """Return whether automatic growth may try another stage now."""
        if not self.auto or host.growth.limit is not None:
            return False
        first, last = self.growth_window
        d = self.cfg.densify
        inside = max(first, d.start) <= host.progress < min(last, d.stop)
        return inside and host.progress - host.densified_at >= self._interval(host)

    def _grow(
        self, state: FitState, host: HostState, bound: int, session: Session
    ) -> tuple[FitState, HostState]:
        """Run a stage twice over the same steps, without growth and with it, and return the better.

        What does not grow runs first. Where time ends within the stage, it is the run: it is never
        behind, and needs no comparison. A checkpoint holds one population: none is written here.
        """
        stage = self._next_stage(state, host, bound)
        if stage is None:
            self._end_growth(state, host)
            return state, host
        begun = host.step
        # Both runs of the stage have the same slots, and so the same random draws.
        needed = stage.target(stage.events)
        state = grow_state(state, bucket_for(needed, state.params.gaussians.capacity, bound))
        plain = jax.tree.map(jnp.copy, state)  # steps give their input away
        plain_host = copy.deepcopy(host)
        plain = self._run_stage(plain, plain_host, stage, session, grows=False)
        if session.over(plain_host):
            self._log_trial_as_run(begun)
            return plain, plain_host
        # Tile lists that were too short once would be so again.
        host.rooms, host.overflows = dict(plain_host.rooms), plain_host.overflows
        with self.clock("densification"):
            score = self.judge(plain.params, plain.population.alive)
        grown = self._run_stage(state, host, stage, session, grows=True)
        if session.over(host):
            plain_host.elapsed_s = host.elapsed_s
            self._log_trial_as_run(begun)
            return plain, plain_host
        with self.clock("densification"):
            psnr = self.judge(grown.params, grown.population.alive)
        progress = round(host.progress, 6)
        result = StageResult(self._count(grown), psnr, stage.before, score, progress)
        host.growth.results.append(result)
        # Tile lists that overflow end bursts early: the two may differ by a few steps.
        kept = grown if result.kept else dataclasses.replace(plain, step=grown.step)
        if host.growth.stalled:
            self._end_growth(kept, host)
        return kept, host

    def _log_trial_as_run(self, begun: int) -> None:
        """Replace the lines of a stage in the log by those of its trial.

        Args:
            begun: steps before the stage.
        """
        lines = [line for line in read_jsonl(self.log_path) if line["step"] <= begun]
        lines += [line for line in read_jsonl(self.trial_path) if line["step"] > begun]
        _write_lines(self.log_path, lines)

    def _next_stage(self, state: FitState, host: HostState, bound: int) -> Stage | None:
        """Return the next stage, or None where there is no room or time for one."""
        left = (self.growth_window[1] - host.progress) / host.pace
        # The host looks after every burst only.
        burst = min(self.cfg.train.log_every, MAX_BURST)
        interval = math.ceil(self._interval(host) / host.pace / burst - 1e-6) * burst
        return growth.plan_stage(self._count(state), bound, left, interval)

    def _run_stage(
        self, state: FitState, host: HostState, stage: Stage, session: Session, *, grows: bool
    ) -> FitState:
        """Run the densifications of a stage and the steps after each; the pace stays.

        It ends early where the time does, or the window of growth.

        Args:
            state: to start from; it is given away.
            host: counters; changed.
            stage: its densifications.
            session: the clock.
            grows: otherwise Gaussians are only relocated.
        """
        for done in range(1, stage.events + 1):
            host.densified_at = host.progress
            with self.clock("densification"):
                state = self._relocate_step(state, host, stage.target(done) if grows else 0)
            while host.progress - host.densified_at < self._interval(host):
                state, _ = self._advance(state, host, session, trial=not grows)
                if session.over(host) or host.progress >= self.growth_window[1]:
                    return state
        return state

    def _end_growth(self, state: FitState, host: HostState) -> None:
        """Keep the population from here on, and fit the held-out views as well."""
        if host.growth.limit is not None:
            return
        host.growth.limit = self._count(state)
        self.views.leave_out(())
        self.on_message(growth.describe(host.growth, len(self.validation)))

    # -------------------------------------------------------------- densification

    def _adaptive_step(self, state: FitState, host: HostState, limit) -> FitState:
        d = self.cfg.densify
        gaussians, population = state.params.gaussians, state.population
        prune_large = host.reset_at > 0
        proposal = self._propose(gaussians, population, self.extent, prune_large)
        wanted = int(proposal.wanted)
        capacity = bucket_for(wanted, gaussians.capacity, limit)
        if limit is not None:
            capacity = min(capacity, max(limit, gaussians.capacity))
        if capacity > gaussians.capacity:
            extra = capacity - gaussians.capacity
            state = grow_state(state, capacity)
            proposal = jax.tree.map(
                lambda a: jnp.concatenate([a, jnp.zeros(extra, bool)]) if a.ndim else a, proposal
            )
        outcome = self._densify_adaptive(
            self._key(host), state.params.gaussians, state.population, proposal
        )
        state = self._settle(state, outcome, host)
        if host.progress - host.reset_at >= max(d.reset_every, d.min_reset_steps * host.pace):
            host.reset_at = host.progress
            state = replace_gaussians(
                state,
                adaptive.reset_opacities(state.params.gaussians),
                state.population,
                zero_opacity_moments(state.opt_state),
            )
        return state

    def _count(self, state: FitState) -> int:
        return int(self._alive(state.population.alive))

    def _settle(self, state: FitState, outcome, host: HostState) -> FitState:
        refused = int(outcome.refused)
        if refused > 0:
            if host.refused == 0:
                self.on_message(
                    f"Step {host.step}: {refused} Gaussians wanted to grow but the limit is "
                    "reached; raise --densify.max-gaussians to let them. Counted from here on."
                )
            host.refused += refused
        if int(self._alive(outcome.population.alive)) == 0:
            raise UserError(
                f"Step {host.step}: densification removed every Gaussian.",
                fix="lower --densify.prune-opacity or raise --densify.prune-scale",
            )
        opt_state = self._zero_moments(state.opt_state, outcome.reset_moments)
        return replace_gaussians(state, outcome.gaussians, outcome.population, opt_state)


def _relocate(key, gaussians, population, moments, births, *, cfg: FitConfig):
    """Relocate and grow towards where the loss pulls most."""
    asked = demand(gaussians, moments, cfg.optimizer.b2)
    return mcmc.relocate_and_grow(key, gaussians, population, births, cfg.densify, asked)


def _repeats(cfg: FitConfig) -> bool:
    """Return whether the same steps give the same bits here."""
    return jax.default_backend() == "cpu" or cfg.render.deterministic


def _name(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _write_lines(path: Path, lines: list[dict]) -> None:
    write_text(path, "".join(json.dumps(line) + "\n" for line in lines))


def _mean(values) -> float:
    return float(np.mean([float(v) for v in values]))
