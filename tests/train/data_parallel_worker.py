"""Train steps on virtual devices, with one or several views, and print the results as JSON.

This runs in a separate process, because JAX counts devices once and tests run with one device. It
needs four (JAX_NUM_CPU_DEVICES=4).
"""

import json
import sys

import jax
import numpy as np
from jax.sharding import Mesh
from noise_views import COUNT, DEGREE, EXTENT, VIEWS, config, start, view

from p2gs_jax.core.numerics import on_host
from p2gs_jax.presets import with_values
from p2gs_jax.render import xla_cpu
from p2gs_jax.render.capacity import Capacity
from p2gs_jax.render.cores import CORES
from p2gs_jax.train.data_parallel import ParallelStep, default_mesh
from p2gs_jax.train.divided import DividedStep
from p2gs_jax.train.inputs import stacked
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import healed, initial_state
from p2gs_jax.train.step import PROGRAMS, Step
from p2gs_jax.train.update import Controls

CAPACITY = Capacity(16_384, 4096)
CONTROLS = on_host(Controls, np.float32(0.3), np.int32(DEGREE), np.float32(0.7), np.uint32(0))


def alive() -> np.ndarray:
    return np.arange(COUNT) % 10 != 0


def first_moments(state):
    return state.opt_state.gaussians.mu, state.opt_state.rest.mu[0].raw_exposures


def mean_of_single_views() -> dict:
    """Return the mean loss and mean first moments of first steps with one view each."""
    cfg = config(method=None)
    optimizer = make_optimizer(cfg)
    step = Step(cfg, optimizer, EXTENT)
    losses, moments = [], []
    for row in range(VIEWS):
        state = initial_state(start(), alive(), optimizer)
        state, report = step(state, *view(row), CONTROLS, capacity=CAPACITY, degree=DEGREE)
        assert int(state.fault.kind) == 0
        losses.append(float(report.loss))
        moments.append(jax.tree.map(np.asarray, first_moments(state)))
    mean = jax.tree.map(lambda *a: np.mean(a, 0), *moments)
    return {"loss": float(np.mean(losses)), "moments": mean}


def on_devices(count: int) -> dict:
    """Return results of two steps on `count` devices; if each has one view, one overflows first."""
    cfg = config(batch=VIEWS)
    optimizer, mesh = make_optimizer(cfg), default_mesh(count)
    step = ParallelStep(cfg, optimizer, EXTENT, cfg.densify.noise, mesh=mesh)
    state = step.spread(initial_state(start(), alive(), optimizer))
    inputs = (*map(stacked, zip(*map(view, range(VIEWS)), strict=True)), CONTROLS)

    lowered = [step.lowered(n, state, *inputs, capacity=CAPACITY, degree=DEGREE) for n in PROGRAMS]
    show, differentiate, advance = (part.compile() for part in lowered)
    losses, first, found = [], None, {}
    if count == VIEWS:
        state, found = overflowing(step, state, inputs, show, advance)
    run = step.chained(show, differentiate, advance)
    for _ in range(2):
        state, report = run(state, *inputs)
        losses.append(float(report.loss))
        first = first or jax.tree.map(np.asarray, first_moments(step.whole(state)))
    state = step.whole(state)
    params = jax.tree.map(np.asarray, state.params)
    return found | {"losses": losses, "moments": first, "params": params, "step": int(state.step)}


def overflowing(step: Step, state, inputs, show, advance):
    """Run a step that overflows; return its state without the fault, then fault and changes."""
    before = jax.tree.map(np.asarray, state.params)
    narrow = step.program("differentiate", Capacity(64, CAPACITY.visible), DEGREE)
    state, _ = step.chained(show, narrow, advance)(state, *inputs)
    fault = {k: int(getattr(state.fault, k)) for k in ("kind", "needed")}
    moved = distance(before, state.params)
    return healed(state), {"fault": fault, "stopped at": int(state.step), "moved": moved}


def over_cores(count: int) -> dict:
    """Return how far two steps with views divided over cores are from steps on one core.

    A step that overflows comes first and must change nothing.
    """
    cfg = with_values(config(method=None), {"loss.dssim_weight": 0.2})
    optimizer, mesh = make_optimizer(cfg), Mesh(np.array(jax.devices()[:count]), (CORES,))
    steps = (Step(cfg, optimizer, EXTENT), DividedStep(cfg, optimizer, EXTENT, mesh=mesh))
    ends, reports, found = [], [], {}
    for step in steps:
        state = step.spread(initial_state(start(), alive(), optimizer))
        show, differentiate, advance = (step.program(name, CAPACITY, DEGREE) for name in PROGRAMS)
        state, found = overflowing(step, state, (*view(0), CONTROLS), show, advance)
        for row in (0, 1):
            state, report = step.chained(show, differentiate, advance)(state, *view(row), CONTROLS)
        end = jax.tree.map(lambda a: a[:COUNT] * 1.0 if a.ndim else a, step.whole(state))
        ends.append((end.params, end.opt_state, end.population))
        reports.append(float(report.loss))
    return found | {"from one core": distance(*ends), "losses": reports}


def distance(tree, other) -> float:
    """Return the largest relative L2 distance of two trees' arrays."""

    def relative(a, b):
        return float(np.linalg.norm(a - b) / max(np.linalg.norm(a), 1e-30))

    return max(map(relative, jax.tree.leaves(tree), jax.tree.leaves(other)))


def main() -> None:
    xla_cpu._CPU_OPTIONS = {}  # XLA's defaults
    single = mean_of_single_views()
    found, reference = {"one view": {"loss": single["loss"]}}, None
    for count in (1, 4):
        result = on_devices(count)
        reference = reference or result
        found[str(count)] = {
            "from one view": distance(single["moments"], result.pop("moments")),
            "from one device": distance(reference["params"], result["params"]),
            **{k: v for k, v in result.items() if k != "params"},
        }
    # The numbers of Gaussians and of tile rows are not multiples of three.
    found["cores"] = over_cores(3)
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
