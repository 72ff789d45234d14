"""Rendering from the host: allocate outside jit, check for overflow, grow, render again."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
from jaxtyping import Array, Bool

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import render_linear, required_capacity
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians, Render

CAPACITY_STEP = 1.25
SMALLEST_CAPACITY = 4096

RenderView = Callable[[Gaussians, Bool[Array, " n"], Camera], Render]


def capacity_bucket(entries: int, margin: float = 1.0) -> int:
    """Return the tile-list capacity for `entries`: a power of 1.25, so that few programs exist."""
    capacity = SMALLEST_CAPACITY
    while capacity < entries * margin:
        capacity = int(capacity * CAPACITY_STEP) + 1
    return capacity


def make_renderer(cfg: RenderConfig) -> RenderView:
    """Return a function that renders one view exactly, growing its tile lists when it must."""
    capacities: dict[tuple[int, int], int] = {}

    @functools.partial(jax.jit, static_argnames="capacity", compiler_options=compiler_options())
    def render(gaussians, alive, camera, capacity):
        return render_linear(gaussians, alive, camera, cfg, capacity)

    count = jax.jit(lambda g, alive, camera: required_capacity(g, alive, camera, cfg))

    def render_view(gaussians: Gaussians, alive: Bool[Array, " n"], camera: Camera) -> Render:
        size = (camera.width, camera.height)
        if size not in capacities:
            capacities[size] = capacity_bucket(int(count(gaussians, alive, camera)), 1.2)
        while True:
            result = render(gaussians, alive, camera, capacity=capacities[size])
            if not bool(result.overflow):
                return result
            capacities[size] = capacity_bucket(int(result.count), 1.1)

    return render_view
