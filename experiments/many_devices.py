"""Steps on 1, 2 and 4 virtual devices: seconds, bytes on the wire, memory; docs/scaling.md.

    python experiments/many_devices.py --out many_devices.json
    python experiments/many_devices.py --meshes 1x1 2x2 --gaussians 200000 --out large.json

Virtual devices are threads of one processor: their seconds say what dividing a step costs, not what
it gains. Bytes are counted in the compiled programs, memory is what the compiler reports.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from p2gs_jax.bench.scenes import street

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.devices import AXES, Devices
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.runtime import tune_process
from p2gs_jax.losses.total import Partner
from p2gs_jax.train.advance import Controls
from p2gs_jax.train.batches import stacked
from p2gs_jax.train.mesh.spread import OnMesh
from p2gs_jax.train.mesh.step import MeshStep
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.room import room_for
from p2gs_jax.train.state import initial_state
from p2gs_jax.train.step import PARTS
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Photometry

MESHES = ("1x1", "2x1", "4x1", "2x2", "1x4")
DEVICES = 4
BYTES = {"f32": 4, "s32": 4, "u32": 4, "f16": 2, "pred": 1, "u8": 1, "s8": 1}
COLLECTIVE = re.compile(r"= (.*?) (all-reduce|all-to-all|all-gather)(?:-start)?\(")
ARRAY = re.compile(r"(\w+)\[([\d,]*)\]")
DEGREE = 3


def wire(text: str, devices: int) -> dict[str, float]:
    """Return the bytes that leave a device in one run of a compiled program, by collective.

    A sum over n devices is taken to go around a ring: each sends 2 (n - 1) / n of it. Of what is
    exchanged each keeps its own part.

    Args:
        text: the compiled program.
        devices: of the mesh, where groups are not said.
    """
    found: dict[str, float] = {}
    for line in text.splitlines():
        match = COLLECTIVE.search(line)
        if match is None:
            continue
        size = sum(
            BYTES.get(kind, 4) * int(np.prod([int(d) for d in shape.split(",") if d]))
            for kind, shape in ARRAY.findall(match[1])
        )
        groups = re.search(r"replica_groups=\{\{([\d,]+)\}", line)
        counted = re.search(r"replica_groups=\[\d+,(\d+)\]", line)
        n = devices
        if groups is not None:
            n = len(groups[1].split(","))
        elif counted is not None:
            n = int(counted[1])
        share = 2 * (n - 1) / n if match[2] == "all-reduce" else (n - 1) / n
        found[match[2]] = found.get(match[2], 0.0) + share * size
    return found


def inputs(args: argparse.Namespace) -> tuple[Params, list[tuple[Batch, Partner]], list[Camera]]:
    """Return a street, photographs of noise of it, and their cameras."""
    scene = street(args.gaussians, args.width, args.height, degree=DEGREE)
    gaussians: Gaussians = jax.tree.map(np.asarray, scene.gaussians)
    views, cameras = [], []
    for row in range(args.batch):
        pose = np.array(scene.camera.viewmat)
        pose[0, 3] += 0.3 * row
        size = (args.width, args.height)
        camera = on_host(Camera, pose, np.asarray(scene.camera.K), *size)
        pixels = np.random.default_rng(row).integers(0, 256, (*size[::-1], 3), np.uint8)
        batch = on_host(Batch, camera, pixels, np.ones(size[::-1], bool), np.int32(row))
        views.append((batch, on_host(Partner, np.int32(0))))
        cameras.append(camera)
    zeros = np.zeros(args.batch, np.float32)
    return on_host(Params, gaussians, on_host(Photometry, zeros, zeros)), views, cameras


def measured(mesh: Mesh, args: argparse.Namespace) -> dict[str, Any]:
    """Return what a step costs on a mesh."""
    base = FitConfig()
    cfg = dataclasses.replace(base, train=dataclasses.replace(base.train, batch=args.batch))
    optimizer = make_optimizer(cfg)
    step, spread = MeshStep(cfg, optimizer, 10.0, mesh), OnMesh(mesh)
    params, views, cameras = inputs(args)
    alive = np.ones(params.gaussians.capacity, bool)
    slots = spread.padded(len(alive))
    room = room_for(params.gaussians, alive, cameras, len(alive), cfg.render)
    state = spread.spread(initial_state(params, jnp.asarray(alive), optimizer, slots))
    batches, partners = zip(*views, strict=True)
    controls = on_host(Controls, np.float32(0.5), np.int32(DEGREE), np.float32(0.1), np.uint32(0))
    given = (stacked(batches), stacked(partners), controls)
    made = {
        name: step.lowered(name, state, *given, room=room, degree=DEGREE).compile()
        for name in PARTS
    }
    sent: dict[str, float] = {}
    for program in made.values():
        for kind, size in wire(program.as_text(), mesh.size).items():
            sent[kind] = sent.get(kind, 0.0) + size
    run = step.chained(*(made[name] for name in PARTS))
    seconds, reports = [], []
    for _ in range(args.steps):
        begin = time.monotonic()
        state, report = jax.block_until_ready(run(state, *given))
        seconds.append(time.monotonic() - begin)
        reports.append(report)
    assert int(state.fault.kind) == 0, state.fault
    memory = {name: program.memory_analysis() for name, program in made.items()}
    flops = {
        name: (program.cost_analysis() or {}).get("flops", 0.0) for name, program in made.items()
    }
    return {
        "seconds": float(np.median(seconds[1:])),
        "losses": [float(report.loss) for report in reports],
        "sent_by_a_device": sent,
        "sent_by_all": mesh.size * sum(sent.values()),
        "state_bytes": memory["advance"].argument_size_in_bytes,
        "temporary_bytes": max(m.temp_size_in_bytes for m in memory.values()),
        "flops": flops,
        "visible": int(reports[-1].visible),
        "entries": int(reports[-1].entries),
        "room": tuple(room),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", nargs="+", default=MESHES, metavar="VxG")
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=208)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", DEVICES)
    tune_process()
    found: dict[str, Any] = {"settings": vars(args) | {"out": None}}
    for name in args.meshes:
        count = int(np.prod([int(part) for part in name.split("x")]))
        mesh = Devices(count, name).mesh()
        assert mesh.axis_names == AXES
        found[name] = row = measured(mesh, args)
        print(
            f"{name}: {row['seconds']:.3f} s a step, {row['sent_by_all'] / 1e6:.1f} MB sent, state "
            f"{row['state_bytes'] / 1e6:.1f} MB, temporary {row['temporary_bytes'] / 1e6:.1f} MB a "
            f"device, loss {row['losses'][0]:.7f} -> {row['losses'][-1]:.7f}",
            flush=True,
        )
        write_json(args.out, json.loads(json.dumps(found)))


if __name__ == "__main__":
    main()
