"""Steps of several views on meshes of virtual devices, in a process of its own: prints JSON.

JAX counts its devices once, so a test run cannot have both one and four: four are wanted here
(XLA_FLAGS=--xla_force_host_platform_device_count=4).
"""

import contextlib
import dataclasses
import json
import shutil
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
from tiny_scene import make_scene

from p2gs_jax.config import FitConfig, preset
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.devices import Devices
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.progress import Silent
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.losses.total import Partner
from p2gs_jax.pipeline.devices import mesh_of
from p2gs_jax.pipeline.fit import optimise
from p2gs_jax.pipeline.prepare import load, prepare
from p2gs_jax.render import xla_cpu
from p2gs_jax.render.capacity import Room
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.train.advance import Controls
from p2gs_jax.train.batches import stacked
from p2gs_jax.train.mesh.spread import OnMesh
from p2gs_jax.train.mesh.step import MeshStep
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.programs import StepPrograms
from p2gs_jax.train.state import initial_state
from p2gs_jax.train.step import PARTS, Step
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Photometry

COUNT, VIEWS = 500, 4
WIDTH, HEIGHT, FOCAL = 48, 32, 45.0
EXTENT, DEGREE = 2.0, 1
ROOM = Room(16_384, 4096)
CONTROLS = on_host(Controls, np.float32(0.3), np.int32(DEGREE), np.float32(0.7), np.uint32(0))


def config(batch: int, method: str | None = "mcmc") -> FitConfig:
    base = FitConfig()
    return dataclasses.replace(
        base,
        render=dataclasses.replace(base.render, sh_degree=DEGREE, pixels_in_flight=2048),
        densify=dataclasses.replace(base.densify, method=method),
        # With an epsilon of about the gradient's size, updates are as smooth as the gradient.
        optimizer=dataclasses.replace(base.optimizer, eps=1e-5),
        train=dataclasses.replace(base.train, batch=batch),
    )


def start() -> Params:
    """Some Gaussians that each view shows and others that it does not."""
    rng = np.random.default_rng(0)
    z = rng.uniform(3, 8, COUNT)
    xy = rng.uniform(-0.9, 0.9, (COUNT, 2)) * z[:, None] * [WIDTH / FOCAL, HEIGHT / FOCAL]
    values = (
        np.concatenate([xy, z[:, None]], 1),
        rng.normal(size=(COUNT, 4)),
        rng.normal(-3, 0.4, (COUNT, 3)),
        rng.normal(-1, 2, COUNT),
        rng.normal(0, 0.3, (COUNT, (DEGREE + 1) ** 2, 3)),
    )
    zeros = np.zeros(VIEWS, np.float32)
    gaussians = on_host(Gaussians, *(a.astype(np.float32) for a in values))
    return on_host(Params, gaussians, on_host(Photometry, zeros + 0.1, zeros))


def view(row: int) -> tuple[Batch, Partner]:
    """A photograph of noise, from its own place."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3] = 1.5 * row - 2
    camera = on_host(Camera, pose, K, WIDTH, HEIGHT)
    ldr = np.random.default_rng(row).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    batch = on_host(Batch, camera, ldr, np.ones((HEIGHT, WIDTH), bool), np.int32(row))
    return batch, on_host(Partner, np.int32(0))


def alive() -> np.ndarray:
    return np.arange(COUNT) % 10 != 0


def of_one_view(rows) -> dict:
    """Loss and first moments after a step of each view, all from the start; their means."""
    cfg = config(1, method=None)
    optimizer = make_optimizer(cfg)
    step = Step(cfg, optimizer, EXTENT)
    losses, moments = [], []
    for row in rows:
        state = initial_state(start(), alive(), optimizer)
        state, report = step(state, *view(row), CONTROLS, room=ROOM, degree=DEGREE)
        assert int(state.fault.kind) == 0
        losses.append(float(report.loss))
        moments.append(jax.tree.map(np.asarray, first_moments(state)))
    mean = jax.tree.map(lambda *a: np.mean(a, 0), *moments)
    return {"loss": float(np.mean(losses)), "moments": mean}


def first_moments(state):
    return state.opt_state.gaussians[0].mu, state.opt_state.rest[0].mu[0].raw_exposures


def on_mesh(shard: str, count: int, batch: int) -> dict:
    """Losses of two steps, moments after the first and parameters after the second."""
    cfg = config(batch)
    optimizer = make_optimizer(cfg)
    mesh = Devices(count, shard).mesh()
    step, spread = MeshStep(cfg, optimizer, EXTENT, mesh), OnMesh(mesh)
    slots = spread.padded(COUNT + 2)
    state = spread.spread(initial_state(start(), alive(), optimizer, slots))
    inputs = (*map(stacked, zip(*map(view, range(batch)), strict=True)), CONTROLS)
    lowered = {n: step.lowered(n, state, *inputs, room=ROOM, degree=DEGREE) for n in PARTS}
    run = step.chained(*(lowered[name].compile() for name in PARTS))
    losses, first = [], None
    for _ in range(2):
        state, report = run(state, *inputs)
        losses.append(float(report.loss))
        first = first or jax.tree.map(np.asarray, first_moments(spread.whole(state)))
    state = spread.whole(state)
    params = jax.tree.map(np.asarray, state.params)
    fault = {name: int(getattr(state.fault, name)) for name in ("kind", "needed", "visible")}
    taken = int(state.step)
    return {"losses": losses, "moments": first, "params": params, "fault": fault, "step": taken}


def refused_then_taken() -> dict:
    """A step without room, and the same with room after the fault: what it did, and its loss."""
    optimizer, mesh = make_optimizer(config(4)), Devices(4, "2x2").mesh()
    step, spread = MeshStep(config(4), optimizer, EXTENT, mesh), OnMesh(mesh)
    before = initial_state(start(), alive(), optimizer, spread.padded(COUNT + 2))
    state = spread.spread(before)
    inputs = (*map(stacked, zip(*map(view, range(4)), strict=True)), CONTROLS)

    def taken(state, room):
        lowered = [step.lowered(n, state, *inputs, room=room, degree=DEGREE) for n in PARTS]
        return step.chained(*(part.compile() for part in lowered))(state, *inputs)

    state, _ = taken(state, Room(64, 4096))
    fault = {name: int(getattr(state.fault, name)) for name in ("kind", "needed", "visible")}
    moved = distance(spread.whole(state).params.gaussians, before.params.gaussians)
    stopped = int(state.step)
    state, report = taken(spread.healed(state), ROOM)
    return {
        "fault": fault,
        "moved": moved,
        "steps": [stopped, int(state.step)],
        "loss": float(report.loss),
    }


def distance(tree, other) -> float:
    """Return the largest relative L2 distance of two trees' arrays, of the rows of the first."""

    def of(a, b):
        a, b = a[:COUNT], b[:COUNT]
        return float(np.linalg.norm(a - b) / max(np.linalg.norm(a), 1e-30))

    return max(map(of, jax.tree.leaves(tree), jax.tree.leaves(other)))


def fitted(folder: Path) -> dict:
    """A fit on 2 x 2 devices, and its last part again on one: how they differ."""
    cfg = with_fields(
        preset("3dgs"),
        {
            "train.steps": 48,
            "train.batch": 4,
            "train.coarse_to_fine": (),
            "train.checkpoint_every_s": 0.0,
            "densify.method": "mcmc",
            "densify.max_gaussians": 301,
            "densify.min_every_steps": 16,
            "render.sh_degree": 1,
            "init.dense": "off",
            "optimizer.eps": 1e-5,
        },
    )
    run = RunFolder(folder / "run")
    run.root.mkdir()
    scene = load(make_scene(folder / "scene"), run.root, cfg, Silent())
    prepared = prepare(scene, cfg, Silent(), Stopwatch())

    def to_the_end(devices: Devices, resume: bool):
        with contextlib.closing(StepPrograms()) as programs:
            mesh = mesh_of(cfg, devices)
            return optimise(prepared, run, Silent(), programs, resume=resume, mesh=mesh)

    whole = to_the_end(Devices(4, "2x2"), resume=False)
    log = run.log.read_text()
    saved = sorted(int(p.name) for p in run.checkpoints.iterdir() if p.name.isdecimal())
    shutil.rmtree(run.checkpoints / str(saved[-1]))
    again = to_the_end(Devices(1), resume=True)
    lines = [
        [json.loads(line) for line in text.splitlines()] for text in (log, run.log.read_text())
    ]
    alive = np.asarray(whole.state.population.alive)
    return {
        "saved": saved,
        "steps": [whole.host.step, again.host.step],
        "gaussians": [int(alive.sum()), int(np.asarray(again.state.population.alive).sum())],
        "slots": whole.state.params.gaussians.capacity,
        "losses": [[line["loss"] for line in one] for one in lines],
        "difference": distance(
            *(jax.tree.map(np.asarray, r.state.params.gaussians) for r in (whole, again))
        ),
    }


def main() -> None:
    xla_cpu._CPU_OPTIONS = {}
    single = of_one_view(range(VIEWS))
    found = {"one view": {"loss": single["loss"]}}
    whole = None
    for shard, count, batch in (
        ("views", 1, 4),
        ("views", 2, 4),
        ("views", 4, 4),
        ("gaussians", 4, 4),
        ("2x2", 4, 4),
    ):
        made = on_mesh(shard, count, batch)
        whole = whole or made
        found[f"{shard} {count}"] = {
            "losses": made["losses"],
            "of one view": distance(single["moments"], made["moments"]),
            "of one device": distance(whole["params"], made["params"]),
            "step": made["step"],
            "fault": made["fault"],
        }
    found["tight"] = refused_then_taken()
    with tempfile.TemporaryDirectory() as folder:
        found["fit"] = fitted(Path(folder))
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
