"""A training loop that computes nothing: a simulated clock, and programs that only count."""

import dataclasses
import os
from types import SimpleNamespace

import numpy as np

from p2gs_jax import FitConfig, with_fields
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.core.numerics import on_host
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.train import loop
from p2gs_jax.train.state import FAULT_NONFINITE, FAULT_OVERFLOW, Fault
from p2gs_jax.train.update import StepReport
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Photometry

VIEWS, SEEDS = 4, 10
FIELDS = {"train.steps": 100, "train.log_every": 5, "train.coarse_to_fine": []}
FIELDS |= {"train.checkpoint_every_s": 1e9, "densify.min_every_steps": 5, "densify.method": None}
SHORT = with_fields(FitConfig(), FIELDS)


class Views:
    """Views of one size, without photographs."""

    def __len__(self):
        return VIEWS

    def indices_at(self, step, count):
        return tuple((step + k) % VIEWS for k in range(count))

    def first_of_sizes(self, step, count):
        return [step]

    def prefetch(self, index, shrink):
        pass

    def camera(self, index, shrink):
        K = np.diag([400.0 / shrink, 400.0 / shrink, 1.0]).astype(np.float32)
        return on_host(Camera, np.eye(4, dtype=np.float32), K, 400 // shrink, 300 // shrink)

    def batch(self, index, shrink, step=0):
        nothing = np.zeros((1, 1, 3), np.uint8), np.ones((1, 1), bool)
        return on_host(Batch, self.camera(index, shrink), *nothing, np.int32(index))


class Programs:
    """Programs that compile in `compile_s` and run in `step_s(width)` seconds of a clock."""

    def __init__(
        self, clock, compile_s=5.0, step_s=lambda width: 0.1, *, overflows_at=None, breaks_at=None
    ):
        self.clock, self.compile_s, self.step_s = clock, compile_s, step_s
        self.capacities, self.waited_s = {}, 0.0
        self.made, self.ran = [], []  # keys; (step, width, progress)
        self.overflows_at, self.breaks_at = overflows_at, breaks_at

    def expect(self, *arguments, **options):
        pass

    def ahead(self, key, program, *arguments, **static):
        return program

    def get(self, step, key, *arguments):
        if key not in self.made:
            self.made.append(key)
            self.clock.now += self.compile_s
            self.waited_s += self.compile_s

        def run(state, batch, partner, controls):
            if int(state.fault.kind):
                return state, REPORT
            self.clock.now += self.step_s(key.size[0])
            at, kind = int(state.step), 0
            if at == self.overflows_at and key.capacity.entries < 10**6:
                kind = FAULT_OVERFLOW
            if at == self.breaks_at:
                kind = FAULT_NONFINITE
            if kind:
                fault = Fault(*map(np.int32, (kind, 10**6, 1, 0)))
                return dataclasses.replace(state, fault=fault), REPORT
            self.ran.append((at, key.size[0], float(controls.progress)))
            return dataclasses.replace(state, step=np.int32(at + 1)), REPORT

        return run


REPORT = StepReport(*map(np.float32, (1, 1, 20, 7, 3)))._replace(terms={"l1": np.float32(1)})


def params():
    values = [np.zeros((SEEDS, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (1, 3))]
    values[0][:, 2], values[1][:, 0], values[2][:] = 3, 1, -5
    zeros = np.zeros(VIEWS, np.float32)
    return Params(on_host(Gaussians, *values), on_host(Photometry, zeros, zeros))


class Harness:
    """A run folder, a clock, and trainers on them one after the other."""

    def __init__(self, folder):
        self.clock = SimpleNamespace(now=0.0)
        self.checkpoints = CheckpointStore(folder / "checkpoints")
        self.folder, self.messages = folder, []

    def run(self, cfg=SHORT, *, resume=False, programs=None, **options):
        programs = programs or Programs(self.clock)
        inputs = (cfg, Views(), 1.0, None, Coverage(400 * 300, 1.0), self.folder, programs)
        hooks = {"on_message": self.messages.append, "now": lambda: self.clock.now}
        trainer = loop.Trainer(*inputs, Decisions.as_given(cfg), **hooks, store=self.checkpoints)
        return trainer.run(params(), np.ones(SEEDS, bool), resume=resume, **options), programs

    def log(self):
        return read_jsonl(self.folder / "log.jsonl")


def signalled(harness, *numbers, at):
    """Return programs whose step `at` sends signals of these numbers to the process."""

    def step_s(width):
        if len(programs.ran) == at:
            for number in numbers:
                os.kill(os.getpid(), number)
        return 0.1

    programs = Programs(harness.clock, step_s=step_s)
    return programs
