"""Capacities of the static arrays of a view: allocate outside jit, check for overflow, grow.

Time depends on what a view needs, memory on the capacity: 54 bytes per entry (BUILD_NOTES, "Growth
and memory"). So capacities are generous, and overflows, which cost a compilation, are rare.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.render import render_linear, required_capacity
from p2gs_jax.render.visible import whole_blocks
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians, Render

STEP = 1.25
SMALLEST = 4096

Result = TypeVar("Result")
# Renders one view: (gaussians, alive, camera, owner=None), as of `render_linear`.
RenderView = Callable[..., Render]


class Margins(NamedTuple):
    """Factors by which a list is longer than needed: when allocated, and after an overflow."""

    first: float
    grown: float


# Pictures on demand: the first view of a size is counted exactly, and one that needs more is
# rendered again at once.
PICTURES = Margins(1.2, 1.1)
# Interactive: a few typical views are counted, and the user may go anywhere; an overflow shows a
# smaller picture until another program is compiled.
ANYWHERE = Margins(1.5, 1.5)
# Training: splats widen before they settle, and an overflow compiles the largest program of a fit.
TRAINING = Margins(1.5, 1.5)
# Gaussians that a training view shows: only views between the sampled ones may show more.
TRAINING_VISIBLE = Margins(1.1, 1.2)
# Lists of training are not shorter than this, whatever was counted.
ENTRIES_PER_GAUSSIAN, FEWEST_ENTRIES = 4, 16_384


def bucket(needed: int, margin: float = 1.0) -> int:
    """Return the length for `needed`: a power of 1.25, so that few programs exist."""
    length = SMALLEST
    while length < needed * margin:
        length = int(length * STEP) + 1
    return length


def until_it_fits(
    draw: Callable[[int], tuple[Result, Any, Any]], entries: int
) -> tuple[Result, int]:
    """Draw a picture, with a longer tile list as long as it overflows.

    `draw` goes from a static number of entries to (result, entries needed, whether they
    overflowed). The number that sufficed is returned with the result.
    """
    while True:
        result, needed, overflow = draw(entries)
        if not bool(overflow):
            return result, entries
        entries = _grown(entries, int(needed), PICTURES)


def _grown(length: int, needed: int, margins: Margins) -> int:
    """Return the length of a list that was too short, if it was."""
    return length if needed <= length else bucket(needed, margins.grown)


class Room(NamedTuple):
    """Static sizes of a training step: tile-list entries, and Gaussians that one view may show."""

    entries: int
    visible: int

    @classmethod
    def allocate(cls, entries: int, visible: int, growth: float, limit: int) -> Room:
        """Return room for all views of one image size, to the end of a run.

        So many entries a view needs at most now, as counted, and so many Gaussians it shows. The
        population may still grow by a factor, at most to `limit`: a view goes on to show the same
        share of it, and Gaussians that share a place are smaller.
        """
        wanted = int(visible * TRAINING_VISIBLE.first * growth)
        lists = int(TRAINING.first * entries * growth**0.5)
        return cls(
            bucket(max(lists, ENTRIES_PER_GAUSSIAN * wanted, FEWEST_ENTRIES)),
            min(whole_blocks(wanted), whole_blocks(limit)),
        )

    def holds(self, other: Room) -> bool:
        """Return whether every view that fits the other fits this."""
        return self.entries >= other.entries and self.visible >= other.visible

    def grown(self, entries: int, visible: int) -> Room:
        """Return room for a view that needs this, with some to spare; only what was short grows."""
        return Room(
            _grown(self.entries, entries, TRAINING), _grown(self.visible, visible, TRAINING_VISIBLE)
        )


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

    `owners` are what `owner` is where it is not given.
    """
    known = None if owners is None else on_device(owners, np.int32)
    capacities: dict[tuple[int, int], int] = {}

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
            capacities[size] = bucket(needed, PICTURES.first)

        def draw(entries: int) -> tuple[Render, Array, Array]:
            render = compiled_renderer()
            result = render(gaussians, alive, camera, cfg=cfg, capacity=entries, owner=owner)
            return result, result.count, result.overflow

        result, capacities[size] = until_it_fits(draw, capacities[size])
        return result

    return render_view
