"""Milliseconds against error, for every option of the kernel."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import ACCURACY, METRICS, Rows
from benchmarks.oracle import errors, truth, untruncated
from benchmarks.scenes import BenchScene, street
from p2gs_jax.config import RenderConfig
from p2gs_jax.render import render_linear
from p2gs_jax.render.capacity import bucket, count_needed
from p2gs_jax.render.xla_cpu import compiler_options

REFERENCE = "reference workload"
# Number of variants compiled and timed together, small enough that programs fit in memory.
BATCH = 8


@dataclasses.dataclass(frozen=True)
class Variant:
    """One value of one option.

    Attributes:
        knob: name of the option.
        setting: its value as text.
        changes: changed fields of `RenderConfig`.
    """

    knob: str
    setting: str
    changes: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """The name in tables and baselines."""
        return f"{self.knob} {self.setting}".strip()


def _knob(knob: str, field: str, *values, label: Callable[[Any], str] = str) -> list[Variant]:
    return [Variant(knob, label(v), ((field, v),)) for v in values]


DEFAULT = Variant("default", "")
# GPUs bin by sorting. Its time on a CPU matters to nobody, so only the long table has it.
QUICK = (DEFAULT, Variant("stop", "none", (("stop_error", None),)))
VARIANTS = (
    DEFAULT,
    *_knob("tile", "tile", (8, 8), (16, 16), (32, 8), label=lambda t: f"{t[0]}x{t[1]}"),
    *_knob("chunk", "chunk", 8, 32),
    *_knob("in flight", "pixels_in_flight", 8192, 131072),
    *_knob("stop", "stop_error", None, 1e-5, 5e-3, 5e-2, label=lambda v: f"{v or 'none'}"),
    *_knob("cutoff", "alpha_cutoff", 1 / 64, 1 / 1024, 1e-5, label=lambda v: f"1/{1 / v:.0f}"),
    *_knob("exp degree", "exp_degree", None, 3, 4, label=lambda v: str(v or "exact")),
    *_knob("binning", "binning", "sorting"),
    Variant(
        "everything",
        "exact",
        tuple(
            (k, getattr(untruncated(RenderConfig()), k))
            for k in ("alpha_cutoff", "stop_error", "exp_degree")
        ),
    ),
)


class MeasuredVariant(NamedTuple):
    """One measured variant.

    Attributes:
        variant: the variant.
        milliseconds: median times of `forward` and `both` (forward and backward).
        ratios: the same times relative to the reference workload of the run.
        error: accuracy metrics against the untruncated float64 truth.
        numerics: the same metrics with the default cutoff; None if the variant changes it.
        entries: number of tile-list entries.
        temporaries: bytes that forward and backward need besides inputs and outputs.
    """

    variant: Variant
    milliseconds: dict[str, float]
    ratios: dict[str, float]
    error: dict[str, float]
    numerics: dict[str, float] | None
    entries: int
    temporaries: int


def interleaved(jobs: Mapping[str, Callable[[], Any]], repeats: int = 7) -> dict[str, float]:
    """Return the median wall time of each job, milliseconds.

    The jobs run in turns, so that a machine that slows down slows all jobs. In every turn a job
    first runs untimed, because the previous job has changed memory and caches. Without this, a
    small job after a large one took 2 to 3 times as long.
    """
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, job in jobs.items():
            jax.block_until_ready(job())
            start = time.perf_counter()
            jax.block_until_ready(job())
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(t)) * 1e3 for name, t in times.items()}


def reference_workload() -> Callable[[], jax.Array]:
    """Return work that uses a machine like rendering: exponentials, products, gathers.

    Times are divided by the time of this work, so that the gate is valid on slower machines.
    """
    x = jax.random.normal(jax.random.key(0), (1 << 21,))
    index = jax.random.permutation(jax.random.key(1), 1 << 21)

    @jax.jit
    def work(x, index):
        y = jnp.cumsum(jnp.exp(-x * x)[index].reshape(2048, 1024), 1)
        return jnp.sum(y @ y.T)

    return lambda: work(x, index)


def cotangent(scene: BenchScene) -> np.ndarray:
    """Return random weights (H, W, 3); the weighted sum of the image is differentiated."""
    shape = (scene.camera.height, scene.camera.width, 3)
    return np.random.default_rng(0).normal(size=shape).astype(np.float32) / np.prod(shape[:2])


def programs(scene: BenchScene, variant: Variant, base: RenderConfig, weights: np.ndarray):
    """Compile one variant.

    Returns:
        Functions without arguments for forward, and for forward and backward; the number of
        entries; and the bytes of temporaries of forward and backward.
    """
    cfg = dataclasses.replace(base, **dict(variant.changes))
    gaussians, alive = scene.gaussians, jnp.ones(scene.gaussians.capacity, bool)
    entries = int(count_needed(gaussians, alive, scene.camera, cfg=cfg))
    capacity = bucket(entries)

    def linear(g):
        return render_linear(g, alive, scene.camera, cfg, capacity, with_depth=False).linear

    def objective(g):
        image = linear(g)
        return jnp.sum(image * weights), image

    options = compiler_options()
    forward = jax.jit(linear, compiler_options=options).lower(gaussians).compile()
    both = jax.jit(jax.grad(objective, has_aux=True), compiler_options=options)
    both = both.lower(gaussians).compile()
    memory: Any = both.memory_analysis()
    temporaries = 0 if memory is None else int(memory.temp_size_in_bytes)
    return (lambda: forward(gaussians)), (lambda: both(gaussians)), entries, temporaries


def sweep_scene(quick: bool) -> BenchScene:
    """Return a street of degree 3, with a contrast of about 5 stops."""
    if quick:
        return street(4000, 256, 144, radius=6.0, degree=3)
    return street(20_000, 640, 360, radius=4.0, spread=1.1, degree=3)


def measure_speed_error(
    scene: BenchScene,
    variants: Sequence[Variant] = VARIANTS,
    *,
    repeats: int = 7,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, count: None,
) -> list[MeasuredVariant]:
    """Time every variant, in batches interleaved with the reference workload; compare with float64.

    `on_progress` is called with (stage, done, count).
    """
    base, weights = RenderConfig(), cotangent(scene)
    on_progress("float64 truth", 0, 1)
    whole = truth(scene.gaussians, scene.camera, untruncated(base), weights)
    same_rules = truth(scene.gaussians, scene.camera, base, weights)
    points = []
    for start in range(0, len(variants), BATCH):
        batch = variants[start : start + BATCH]
        jobs: dict[str, Callable[[], Any]] = {REFERENCE: reference_workload()}
        facts = {}
        for i, v in enumerate(batch):
            on_progress("variants", start + i, len(variants))
            forward, both, *facts[v.name] = programs(scene, v, base, weights)
            jobs[f"{v.name} forward"], jobs[f"{v.name} both"] = forward, both
        times = interleaved(jobs, repeats)
        for v in batch:
            entries, temporaries = facts[v.name]
            gradient, linear = jax.tree.map(np.asarray, jobs[f"{v.name} both"]())
            linear = linear.astype(np.float64)
            rules = "alpha_cutoff" not in dict(v.changes)
            ms = {k: times[f"{v.name} {k}"] for k in ("forward", "both")}
            ratios = {k: t / times[REFERENCE] for k, t in ms.items()}
            error = errors(linear, gradient, whole)
            numerics = errors(linear, gradient, same_rules) if rules else None
            points.append(MeasuredVariant(v, ms, ratios, error, numerics, entries, temporaries))
    on_progress("variants", len(variants), len(variants))
    return points


def gate_rows(points: list[MeasuredVariant]) -> Rows:
    """Return the values that the gate compares, by variant.

    The total error includes the effect of the cutoff; `numerics ...` is the error of the
    implementation alone.
    """
    return {
        p.variant.name: {**p.error, **p.ratios}
        | {f"numerics {k}": v for k, v in (p.numerics or {}).items()}
        for p in points
    }


def table(points: list[MeasuredVariant]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows; a star marks variants that no other beats in both time and error."""
    rows = []
    for p in points:
        beaten = any(
            q.milliseconds["both"] < p.milliseconds["both"]
            and q.error["gradient"] < p.error["gradient"]
            for q in points
        )
        numerics = p.numerics or {}
        rows.append(
            [
                p.variant.name + ("" if beaten else " *"),
                *(f"{p.milliseconds[k]:.1f}" for k in ("forward", "both")),
                *(number(k, p.error) for k in ACCURACY),
                *(number(k, numerics) for k in ("relative", "gradient")),
                f"{p.entries / 1e3:.0f}k",
                f"{p.temporaries / 1e6:.0f}",
            ]
        )
    header = ["variant (* on the front)", "fwd ms", "fwd+bwd ms"]
    header += [METRICS[k].title for k in ACCURACY]
    return [*header, "rel., same cutoff", "grad., same cutoff", "entries", "MB"], rows


def number(metric: str, values: Mapping[str, float]) -> str:
    """Return one value as text for a table; empty if it was not measured."""
    if metric not in values:
        return ""
    return f"{values[metric]:.1f}" if metric == "psnr" else f"{values[metric]:.1e}"
