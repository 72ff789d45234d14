"""Scaling of time and memory with Gaussians, pixels, overlap and views."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from p2gs_jax.bench.scenes import BenchScene, street
from p2gs_jax.bench.speed_error import DEFAULT, cotangent, programs
from p2gs_jax.bench.timing import interleaved
from p2gs_jax.config import RenderConfig
from p2gs_jax.render import render_linear, required_capacity
from p2gs_jax.render.capacity import bucket
from p2gs_jax.render.xla_cpu import compiler_options

PIXELS, COUNT, RADIUS = (960, 650), 100_000, 3.0


class Sample(NamedTuple):
    """One point of a curve.

    Attributes:
        work: value of the quantity that grows.
        forward: milliseconds.
        both: milliseconds, forward and backward.
        entries: tile-list entries.
        temporaries: bytes that forward and backward need beside inputs and outputs.
    """

    work: float
    forward: float
    both: float
    entries: int
    temporaries: int


class GrowthCurve(NamedTuple):
    """Samples along one axis, and the exponents p of time ~ work^p fitted to them.

    Attributes:
        axis: quantity that grows.
        held: quantities that stay the same.
        samples: in growing order.
        forward_exponent: least squares in log-log.
        both_exponent: least squares in log-log, forward and backward.
        last_exponents: slopes between the last two samples, where fixed costs no longer show.
    """

    axis: str
    held: str
    samples: list[Sample]
    forward_exponent: float
    both_exponent: float
    last_exponents: tuple[float, float]


def scenes(quick: bool = False) -> dict[str, tuple[str, list[tuple[float, BenchScene]]]]:
    """Return per axis what is held and the scenes, in growing order of work."""
    counts = (10_000, 30_000, 100_000) if quick else (10_000, 30_000, 100_000, 300_000, 1_000_000)
    scales = (0.25, 0.5, 1.0) if quick else (0.25, 0.5, 1.0, 2.0)
    radii = (1.5, 3.0, 6.0) if quick else (1.5, 3.0, 6.0, 12.0)
    w, h = PIXELS
    return {
        "Gaussians": (
            "pixels and overlap",
            [(n, street(n, w, h, radius=RADIUS * (COUNT / n) ** 0.5)) for n in counts],
        ),
        "Gaussians, their size kept": (
            "pixels and radius",
            [(n, street(n, w, h, radius=RADIUS)) for n in counts],
        ),
        "pixels": (
            "Gaussians and overlap",
            [
                (int(w * s) * int(h * s), street(COUNT, int(w * s), int(h * s), radius=RADIUS * s))
                for s in scales
            ],
        ),
        "overlap": (
            "Gaussians and pixels",
            [((r / RADIUS) ** 2, street(COUNT, w, h, radius=r)) for r in radii],
        ),
    }


def exponent(work, times) -> float:
    """Return p of the least-squares line log time = p log work + c."""
    return float(np.polyfit(np.log(np.asarray(work, float)), np.log(np.asarray(times)), 1)[0])


def _curve(axis: str, held: str, samples: list[Sample]) -> GrowthCurve:
    work = [s.work for s in samples]
    return GrowthCurve(
        axis,
        held,
        samples,
        exponent(work, [s.forward for s in samples]),
        exponent(work, [s.both for s in samples]),
        (
            exponent(work[-2:], [s.forward for s in samples[-2:]]),
            exponent(work[-2:], [s.both for s in samples[-2:]]),
        ),
    )


def measure_growth(
    *,
    quick: bool = False,
    repeats: int = 5,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, count: None,
) -> list[GrowthCurve]:
    """Measure every axis; each axis is one interleaved run."""
    curves = []
    base = RenderConfig()
    for axis, (held, rows) in scenes(quick).items():
        jobs: dict[str, Callable[[], Any]] = {}
        facts = []
        for i, (work, scene) in enumerate(rows):
            on_progress(f"growth with {axis}", i, len(rows))
            weights = cotangent(scene)
            jobs[f"f{i}"], jobs[f"b{i}"], _, need, memory = programs(scene, DEFAULT, base, weights)
            facts.append((work, need, memory))
        times = interleaved(jobs, repeats)
        samples = [
            Sample(work, times[f"f{i}"], times[f"b{i}"], need, memory)
            for i, (work, need, memory) in enumerate(facts)
        ]
        curves.append(_curve(axis, held, samples))
    curves.append(_views(quick, repeats))
    return curves


def _views(quick: bool, repeats: int) -> GrowthCurve:
    """Several views in one program, one after another (a batch of a data-parallel step)."""
    scene = street(20_000, 640, 360, radius=4.0)
    cfg = RenderConfig()
    alive = jnp.ones(scene.gaussians.capacity, bool)
    capacity = bucket(int(required_capacity(scene.gaussians, alive, scene.camera, cfg)), 2)
    weights = jnp.asarray(cotangent(scene))
    jobs: dict[str, Callable[[], Any]] = {}
    facts = []
    for views in (1, 2, 4) if quick else (1, 2, 4, 8):
        shift = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
        shift[:, 0, 3] = 0.02 * np.arange(views)

        def image(g, viewmat):
            camera = dataclasses.replace(scene.camera, viewmat=viewmat)
            return render_linear(g, alive, camera, cfg, capacity, with_depth=False).linear

        def forward(g, viewmats):
            return jax.lax.map(lambda m: image(g, m), viewmats)

        def objective(g, viewmats):
            return jnp.sum(jax.lax.map(lambda m: jnp.sum(image(g, m) * weights), viewmats))

        options = compiler_options()
        args = scene.gaussians, jnp.asarray(shift)
        f = jax.jit(forward, compiler_options=options).lower(*args).compile()
        b = jax.jit(jax.grad(objective), compiler_options=options).lower(*args).compile()
        jobs[f"f{views}"] = lambda f=f, args=args: f(*args)
        jobs[f"b{views}"] = lambda b=b, args=args: b(*args)
        memory: Any = b.memory_analysis()
        facts.append((views, 0 if memory is None else int(memory.temp_size_in_bytes)))
    times = interleaved(jobs, repeats)
    samples = [
        Sample(views, times[f"f{views}"], times[f"b{views}"], capacity, memory)
        for views, memory in facts
    ]
    return _curve("views in one program", "scene and size", samples)
