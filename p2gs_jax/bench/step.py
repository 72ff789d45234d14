"""Times of the parts of an optimisation step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from p2gs_jax.bench.scenes import BenchScene
from p2gs_jax.bench.timing import interleaved
from p2gs_jax.config import FitConfig
from p2gs_jax.gaussians import mcmc
from p2gs_jax.losses.image import photometric_loss
from p2gs_jax.losses.total import Partner
from p2gs_jax.photometry.formation import formation
from p2gs_jax.render import bin_tiles, project, rasterize, required_capacity, view_radiance
from p2gs_jax.render.blocks import whole_blocks
from p2gs_jax.render.capacity import Room, bucket
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.train.advance import Controls
from p2gs_jax.train.optimizer import learning_rates, make_optimizer
from p2gs_jax.train.state import initial_state
from p2gs_jax.train.step import Step, compilations
from p2gs_jax.types import Batch, Capture, Params, Photometry


class StepCost(NamedTuple):
    """Medians of one run, milliseconds; forward and backward together.

    Attributes:
        parts: name of the part to its time, over all Gaussians at once; `rasterizer` includes
            binning.
        whole: the jitted step as training runs it.
        compilations: programs that the step was compiled into while its capacity stayed.
    """

    parts: dict[str, float]
    whole: float
    compilations: int


class WholeStep(NamedTuple):
    """The jitted step as training runs it, on one view.

    Attributes:
        run: takes a step, from where the last one ended, and returns its loss.
        compilations: returns how many programs the step has become that were not there before.
        fault: returns the kind of the first fault; after one, steps do nothing.
    """

    run: Callable[[], Any]
    compilations: Callable[[], int]
    fault: Callable[[], int]


def whole_step(scene: BenchScene, cfg: FitConfig, batch: Batch, entries: int) -> WholeStep:
    """Return the step of a fit of `scene`.

    Args:
        scene: what to fit.
        cfg: as for a fit.
        batch: the view.
        entries: room in the tile lists.
    """
    alive = jnp.ones(scene.gaussians.capacity, bool)
    params = Params(scene.gaussians, Photometry(jnp.zeros(4), jnp.zeros(4)))
    optimizer = make_optimizer(cfg)
    # The step donates its state: the scene keeps its own copy.
    holder = [jax.tree.map(jnp.copy, initial_state(params, alive, optimizer))]
    controls = Controls(
        jnp.float32(0.5), jnp.int32(cfg.render.sh_degree), jnp.float32(1), jnp.uint32(0)
    )
    partner = Partner(jnp.int32(0))
    step, before = Step(cfg, optimizer, 1.0), compilations()
    room, degree = Room(entries, whole_blocks(scene.gaussians.capacity)), cfg.render.sh_degree

    def run():
        holder[0], report = step(holder[0], batch, partner, controls, room=room, degree=degree)
        return report.loss

    return WholeStep(run, lambda: compilations() - before, lambda: int(holder[0].fault.kind))


def measure_step(scene: BenchScene, cfg: FitConfig, repeats: int = 7) -> StepCost:
    """Time a full step and its parts on one view.

    Args:
        scene: what to fit; its own image at half the exposure is the photograph.
        cfg: as for a fit.
        repeats: timed runs of each part.
    """
    gaussians, camera = scene.gaussians, scene.camera
    alive = jnp.ones(gaussians.capacity, bool)
    capacity = bucket(int(required_capacity(gaussians, alive, camera, cfg.render)), 1.1)
    params = Params(gaussians, Photometry(jnp.zeros(4), jnp.zeros(4)))
    optimizer = make_optimizer(cfg)
    state = initial_state(params, alive, optimizer)
    state_population = jax.tree.map(jnp.copy, state.population)
    rng = np.random.default_rng(0)
    shape = (camera.height, camera.width)
    photograph = rng.integers(0, 256, (*shape, 3), np.uint8)
    ldr, mask = jnp.asarray(photograph / np.float32(255)), jnp.ones(shape)
    batch = Batch(camera, ldr, mask, jnp.int32(0))

    def jit(f):
        return jax.jit(f, compiler_options=compiler_options())

    splats_of = lambda g: project(g, alive, camera, cfg.render)  # noqa: E731
    radiance_of = lambda g: view_radiance(g, camera, cfg.render)  # noqa: E731
    splats, radiance = jit(splats_of)(gaussians), jit(radiance_of)(gaussians)
    linear = jnp.full((*shape, 3), 0.3)
    v_linear = jnp.full_like(linear, 1e-3)
    differentiable = (
        splats.means2d,
        splats.conic_factor,
        splats.log_opacities,
    )

    def raster(leaves, radiance):
        s = dataclasses.replace(
            splats, means2d=leaves[0], conic_factor=leaves[1], log_opacities=leaves[2]
        )
        tiles = bin_tiles(s, camera.width, camera.height, capacity, cfg.render)
        return rasterize(
            s, radiance, tiles, camera.width, camera.height, cfg.render, with_depth=False
        )[0]

    def both(f):
        def run(v, *args):
            out, pull = jax.vjp(f, *args)
            return out, pull(v)

        return jit(run)

    def loss(linear):
        y = formation(linear, Capture(jnp.float32(0.5), jnp.float32(2.2)), cfg.photometry)
        return sum(photometric_loss(y, ldr, mask, cfg.loss).values())

    def update(params, moments, grads):
        bands = params.gaussians.sh.shape[1]
        rates = learning_rates(jnp.float32(0.5), jnp.float32(1), 1.0, params, cfg, bands).gaussians
        rows = cast(Any, params.gaussians)
        updates, moments = optimizer.gaussians.update(cast(Any, grads), moments, rows, rates=rates)
        return optax.apply_updates(rows, updates), moments

    v_splats = jax.tree.map(jnp.ones_like, differentiable)

    def geometry(g):
        s = splats_of(g)
        return s.means2d, s.conic_factor, s.log_opacities

    raster_both, geometry_both = both(raster), both(geometry)
    radiance_both = both(radiance_of)
    loss_both, apply = jit(jax.value_and_grad(loss)), jit(update)
    relocate = jax.jit(
        lambda g: mcmc.relocate_and_grow(
            jax.random.key(0), g, state_population, jnp.int32(0), cfg.densify
        )
    )
    jobs = {
        "project": lambda: geometry_both(v_splats, gaussians),
        "radiance (SH)": lambda: radiance_both(radiance, gaussians),
        "rasterizer": lambda: raster_both(v_linear, differentiable, radiance),
        "loss": lambda: loss_both(linear),
        "optimizer": lambda: apply(params, state.opt_state.gaussians, params.gaussians),
        "densify (a step)": lambda: relocate(gaussians),
        "transfer": lambda: jax.device_put(photograph).astype(jnp.float32) / 255,
    }
    step = whole_step(scene, cfg, batch, capacity)
    jobs["whole"] = step.run
    times = interleaved(jobs, repeats)
    whole_ms = times.pop("whole")
    times["densify (a step)"] /= cfg.densify.min_every_steps
    return StepCost(times, whole_ms, step.compilations())
