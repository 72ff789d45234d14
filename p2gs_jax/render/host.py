"""Rendering of single views: allocate outside jit, check for overflow, grow, render again."""

from __future__ import annotations

import functools
import threading
from dataclasses import replace
from typing import Any, Protocol

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.render import culling, render_linear, required_capacity
from p2gs_jax.render.capacity import TileCapacity, until_it_fits
from p2gs_jax.render.culling import Blocks
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


class _Culled:
    """The blocks of the population that was rendered last, where it is large enough for them."""

    def __init__(self, cfg: RenderConfig):
        self._cfg = cfg
        self._of: tuple[Gaussians, Array] | None = None
        self._blocks: Blocks | None = None
        self._lock = threading.Lock()

    def blocks(self, gaussians: Gaussians, alive: Bool[Array, " n"]) -> Blocks | None:
        """Return them; None: few Gaussians, moving ones, or a device that projects fast."""
        few = gaussians.capacity < culling.FEWEST or jax.default_backend() != "cpu"
        if few or gaussians.vibration is not None:
            return None
        with self._lock:
            if self._of is None or self._of[0] is not gaussians or self._of[1] is not alive:
                self._blocks = Blocks(gaussians, np.asarray(alive), self._cfg)
                self._of = gaussians, alive
            return self._blocks


def make_renderer(cfg: RenderConfig, owners: Int[np.ndarray, " n"] | None = None) -> RenderView:
    """Return a function that renders one view, and grows its tile lists after an overflow.

    Of millions of Gaussians it takes those that the view may show (`culling.py`).

    Args:
        cfg: rendering options.
        owners: what `owner` is where it is not given.
    """
    known = None if owners is None else on_device(owners, np.int32)
    capacities: dict[tuple[int, int], TileCapacity] = {}
    culled = _Culled(cfg)

    def render_view(
        gaussians: Gaussians,
        alive: Bool[Array, " n"],
        camera: Camera,
        owner: Int[Array, " n"] | None = None,
    ) -> Render:
        owner = known if owner is None else owner
        blocks = culled.blocks(gaussians, alive) if owner is None else None
        if blocks is None or not blocks.leave_out_much(camera):
            return whole(gaussians, alive, camera, owner)
        rows = blocks.of_view(camera)
        some, used = blocks.take(rows)
        result = whole(some, on_device(used, bool), camera, None)
        visible = np.zeros(gaussians.capacity, bool)
        visible[rows] = np.asarray(result.visible)[: len(rows)]
        return replace(result, visible=on_device(visible, bool))

    def whole(
        gaussians: Gaussians,
        alive: Bool[Array, " n"],
        camera: Camera,
        owner: Int[Array, " n"] | None,
    ) -> Render:
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
