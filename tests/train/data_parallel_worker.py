"""Steps of several views on virtual devices, in a process of its own: prints JSON.

JAX counts its devices once, so a test run cannot have both one and four: four are wanted here
(XLA_FLAGS=--xla_force_host_platform_device_count=4).
"""

import json
import sys

import jax
import numpy as np
from noise_views import COUNT, DEGREE, EXTENT, VIEWS, config, start, view

from p2gs_jax.core.numerics import on_host
from p2gs_jax.render import xla_cpu
from p2gs_jax.render.capacity import Room
from p2gs_jax.train.data_parallel import ParallelStep, default_mesh, spread, whole
from p2gs_jax.train.inputs import stacked
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import healed, initial_state
from p2gs_jax.train.step import PROGRAMS, Step
from p2gs_jax.train.update import Controls

ROOM = Room(16_384, 4096)
CONTROLS = on_host(Controls, np.float32(0.3), np.int32(DEGREE), np.float32(0.7), np.uint32(0))


def alive() -> np.ndarray:
    return np.arange(COUNT) % 10 != 0


def first_moments(state):
    return state.opt_state.gaussians.mu, state.opt_state.rest.mu[0].raw_exposures


def of_one_view() -> dict:
    """Loss and first moments after a step of each view, all from the start; their means."""
    cfg = config(method=None)
    optimizer = make_optimizer(cfg)
    step = Step(cfg, optimizer, EXTENT)
    losses, moments = [], []
    for row in range(VIEWS):
        state = initial_state(start(), alive(), optimizer)
        state, report = step(state, *view(row), CONTROLS, room=ROOM, degree=DEGREE)
        assert int(state.fault.kind) == 0
        losses.append(float(report.loss))
        moments.append(jax.tree.map(np.asarray, first_moments(state)))
    mean = jax.tree.map(lambda *a: np.mean(a, 0), *moments)
    return {"loss": float(np.mean(losses)), "moments": mean}


def on_devices(count: int) -> dict:
    """A step without room, then two with it: losses, fault, moments and parameters."""
    cfg = config(batch=VIEWS)
    optimizer, mesh = make_optimizer(cfg), default_mesh(count)
    step = ParallelStep(cfg, optimizer, EXTENT, cfg.densify.noise, mesh=mesh)
    state = spread(initial_state(start(), alive(), optimizer), mesh)
    inputs = (*map(stacked, zip(*map(view, range(VIEWS)), strict=True)), CONTROLS)

    lowered = [step.lowered(n, state, *inputs, room=ROOM, degree=DEGREE) for n in PROGRAMS]
    show, differentiate, advance = (part.compile() for part in lowered)
    losses, first, found = [], None, {}
    if count == VIEWS:
        before = jax.tree.map(np.asarray, state.params)
        narrow = step.program("differentiate", Room(64, ROOM.visible), DEGREE)
        state, _ = step.chained(show, narrow, advance)(state, *inputs)
        found["fault"] = {k: int(getattr(state.fault, k)) for k in ("kind", "needed")}
        found["stopped at"] = int(state.step)
        found["moved"] = distance(before, state.params)
        state = healed(state)
    run = step.chained(show, differentiate, advance)
    for _ in range(2):
        state, report = run(state, *inputs)
        losses.append(float(report.loss))
        first = first or jax.tree.map(np.asarray, first_moments(whole(state, mesh)))
    state = whole(state, mesh)
    params = jax.tree.map(np.asarray, state.params)
    return found | {"losses": losses, "moments": first, "params": params, "step": int(state.step)}


def distance(tree, other) -> float:
    """Return the largest relative L2 distance of two trees' arrays."""

    def of(a, b):
        return float(np.linalg.norm(a - b) / max(np.linalg.norm(a), 1e-30))

    return max(map(of, jax.tree.leaves(tree), jax.tree.leaves(other)))


def main() -> None:
    xla_cpu._CPU_OPTIONS = {}
    single = of_one_view()
    found = {"one view": {"loss": single["loss"]}}
    whole = None
    for count in (1, 4):
        made = on_devices(count)
        whole = whole or made
        found[str(count)] = {
            "of one view": distance(single["moments"], made.pop("moments")),
            "of one device": distance(whole["params"], made["params"]),
            **{k: v for k, v in made.items() if k not in ("moments", "params")},
        }
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
