"""Compile the steps of a fit for GPUs that are not there; print memory and FLOPs per device.

    pip install 'p2gs-jax[cuda]'
    python experiments/compile_for_gpu.py experiments/h100.txtpb --mesh 4x1 --batch 4

Needs JAX's CUDA plugin, no GPU and no driver. TARGET describes the GPU as XLA does
(`--xla_gpu_target_config_filename`; XLA's sources have such files for common ones). Figures are the
compiler's: what a step takes at most, not what was measured.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import topologies
from jax.sharding import Mesh

from p2gs_jax.config import FitConfig
from p2gs_jax.core.devices import AXES
from p2gs_jax.core.numerics import on_host
from p2gs_jax.gaussians.population import empty_gaussians
from p2gs_jax.losses.total import Partner
from p2gs_jax.render.capacity import Room
from p2gs_jax.train.advance import Controls
from p2gs_jax.train.mesh.step import MeshStep
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import initial_state
from p2gs_jax.train.step import PARTS
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Photometry

DEGREE = 3


def shapes(args: argparse.Namespace, optimizer) -> tuple[Any, ...]:
    """Return the state and the inputs of a step, as shapes."""
    of_one = [np.zeros((1, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (16, 3))]
    gaussians = empty_gaussians(args.gaussians, on_host(Gaussians, *of_one))
    zeros = np.zeros(args.views, np.float32)
    params = Params(gaussians, on_host(Photometry, zeros, zeros))
    alive = np.ones(args.gaussians, bool)
    start = functools.partial(initial_state, optimizer=optimizer)
    size, every = (args.height, args.width), (args.batch,)
    camera = on_host(
        Camera,
        np.zeros((*every, 4, 4), np.float32),
        np.zeros((*every, 3, 3), np.float32),
        args.width,
        args.height,
    )
    batch = on_host(
        Batch,
        camera,
        np.zeros((*every, *size, 3), np.uint8),
        np.zeros((*every, *size), bool),
        np.zeros(every, np.int32),
    )
    controls = on_host(Controls, np.float32(0), np.int32(DEGREE), np.float32(1), np.uint32(0))
    given = (batch, on_host(Partner, np.zeros(every, np.int32)), controls)
    return jax.eval_shape(start, params, alive), *given


def _cost(lowered: Any, made: Any) -> dict[str, float]:
    """Return the compiler's count, of the program before it optimised where it keeps no other."""
    for program in (made, lowered):
        try:
            found = program.cost_analysis()
        except Exception:  # a plugin need not count
            continue
        if found and found.get("flops"):
            return found
    return {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", type=Path)
    parser.add_argument("--mesh", default="1x1", metavar="VxG")
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--shown", type=float, default=0.5, help="share that a view shows")
    parser.add_argument("--entries", type=int, default=6, help="tile-list entries per one shown")
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--height", type=int, default=1080)
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--implementation", choices=("xla", "pallas"), default="pallas")
    args = parser.parse_args()
    counts = tuple(int(part) for part in args.mesh.split("x"))
    topology = topologies.get_topology_desc(
        topology_name="",
        platform="cuda",
        target_config=args.target.read_text(),
        topology=f"1x1x{np.prod(counts)}",
    )
    # What is chosen by the backend while tracing is chosen for the target.
    jax.default_backend = lambda: "gpu"
    base = FitConfig()
    cfg = dataclasses.replace(
        base,
        train=dataclasses.replace(base.train, batch=args.batch),
        render=dataclasses.replace(base.render, implementation=args.implementation),
    )
    optimizer = make_optimizer(cfg)
    mesh = Mesh(np.array(topology.devices).reshape(counts), AXES)
    step = MeshStep(cfg, optimizer, 10.0, mesh)
    state, *given = shapes(args, optimizer)
    visible = int(args.shown * args.gaussians)
    room = Room(args.entries * visible, visible)
    for name in PARTS:
        begin = time.monotonic()
        lowered = step.lowered(name, state, *given, room=room, degree=DEGREE)
        try:
            made = lowered.compile()
        except Exception as error:
            print(f"{name}: {type(error).__name__}: {str(error)[:600]}", flush=True)
            continue
        memory, cost = made.memory_analysis(), _cost(lowered, made)
        print(
            f"{name}: {time.monotonic() - begin:.0f} s; arguments "
            f"{memory.argument_size_in_bytes / 1e6:.0f} MB, results "
            f"{memory.output_size_in_bytes / 1e6:.0f}, temporary "
            f"{memory.temp_size_in_bytes / 1e6:.0f} MB; {cost.get('flops', 0) / 1e9:.2f} GFLOP, "
            f"{cost.get('bytes accessed', 0) / 1e9:.2f} GB accessed (0: not said)",
            flush=True,
        )


if __name__ == "__main__":
    main()
