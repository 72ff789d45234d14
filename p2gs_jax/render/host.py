"""Rendering of single views: allocate outside jit, check for overflow, grow, render again."""

from __future__ import annotations

import functools
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.render import render_linear, required_capacity
from p2gs_jax.render.capacity import TileCapacity, until_it_fits
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians, Render


class RenderView(Protocol):
    """Render one view; arguments as of `render_linear`."""

    def __call__(
        self,
        gaussians: Gaussians,
        alive: Bool[Array, " n"],
        camera: Camera,
        owner: Int[Array, " n"] | None = None,
    ) -> Render:
        """Return the render."""
        ...


count_needed = jax.jit(required_capacity, static_argnames="cfg")
"""`required_capacity`, compiled."""


@functools.cache
def compiled_renderer() -> Any:
    """Return `render_linear`, compiled; static are `cfg`, `capacity` and `with_depth`.

    On first use: its options depend on the backend, which an import should not start.
    """
    static = ("cfg", "capacity", "with_depth")
    return jax.jit(render_linear, static_argnames=static, compiler_options=compiler_options())


def make_renderer(cfg: RenderConfig, owners: Int[np.ndarray, " n"] | None = None) -> RenderView:
    """Return a function that renders one view, and grows its tile lists after an overflow.

    Args:
        cfg: rendering options.
        owners: what `owner` is where it is not given.
    """
    known = None if owners is None else on_device(owners, np.int32)
    capacities: dict[tuple[int, int], TileCapacity] = {}

    def render_view(
        gaussians: Gaussians,
        alive: Bool[Array, " n"],
        camera: Camera,
        owner: Int[Array, " n"] | None = None,
    ) -> Render:
        owner = known if owner is None else owner
        size = (camera.width, camera.height)
        if size not in capacities:
            needed = int(count_needed(gaussians, alive, camera, cfg=cfg, owner=owner))
            capacities[size] = TileCapacity.allocate(needed)

        def draw(entries: int) -> tuple[Render, Array, Array]:
            render = compiled_renderer()
            result = render(gaussians, alive, camera, cfg=cfg, capacity=entries, owner=owner)
            return result, result.count, result.overflow

        result, capacities[size] = until_it_fits(draw, capacities[size])
        return result

    return render_view
