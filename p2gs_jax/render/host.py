"""Rendering of single views: allocate outside jit, check for overflow, grow, render again."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
from jaxtyping import Array, Bool

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import render_linear, required_capacity
from p2gs_jax.render.capacity import bucket
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians, Render

RenderView = Callable[[Gaussians, Bool[Array, " n"], Camera], Render]


@functools.cache
def _programs(cfg: RenderConfig):
    """Return the jitted renderer and counter; renderers of one configuration share them."""

    @functools.partial(jax.jit, static_argnames="capacity", compiler_options=compiler_options())
    def render(gaussians, alive, camera, capacity):
        return render_linear(gaussians, alive, camera, cfg, capacity)

    return render, jax.jit(lambda g, alive, camera: required_capacity(g, alive, camera, cfg))


def make_renderer(cfg: RenderConfig) -> RenderView:
    """Return a function that renders one view, and grows its tile lists after an overflow."""
    capacities: dict[tuple[int, int], int] = {}
    render, count = _programs(cfg)

    def render_view(gaussians: Gaussians, alive: Bool[Array, " n"], camera: Camera) -> Render:
        size = (camera.width, camera.height)
        if size not in capacities:
            capacities[size] = bucket(int(count(gaussians, alive, camera)), 1.2)
        while True:
            result = render(gaussians, alive, camera, capacity=capacities[size])
            if not bool(result.overflow):
                return result
            capacities[size] = bucket(int(result.count), 1.1)

    return render_view
