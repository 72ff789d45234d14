"""Capacities of the static arrays of a view: allocate outside jit, check for overflow, grow.

Time depends on the entries that a view uses, memory on the capacity: 54 bytes per entry
(BUILD_NOTES, "Growth and memory"). So capacities are generous, and overflows, each of which costs a
compilation, are rare.
"""

from __future__ import annotations

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.render import render_linear, required_capacity
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians, Render

STEP = 1.25  # ratio of consecutive list lengths
SMALLEST = 4096  # entries

Result = TypeVar("Result")
# Renders one view: (gaussians, alive, camera), the arguments of `render_linear`.
RenderView = Callable[..., Render]

# Ratios of a list's length to the length needed, at first and (GROWN) after an overflow.
# Pictures on demand: the first view of a size is counted exactly, and a view that needs more is
# rendered again at once.
PICTURES, PICTURES_GROWN = 1.2, 1.1
# Viewer: a few typical views are counted, and the user may go anywhere. After an overflow the
# viewer shows a smaller picture until another program is compiled.
ANYWHERE = 1.5
# Training, both at first and after an overflow: splats widen before they converge, and an overflow
# compiles the largest program of a fit.
TRAINING = 1.5
# Gaussians that a training view shows: only views between the sampled ones may show more.
TRAINING_VISIBLE, VISIBLE_GROWN = 1.1, 1.2
# Largest number of canvas sizes of a scene; smaller numbers are used if that pads less than this
# share of the pixels.
MOST_CANVASES, LEAST_PADDING = 3, 0.01


def canvases(sizes: Iterable[tuple[int, int]]) -> dict[tuple[int, int], tuple[int, int]]:
    """Return for every image size (width, height) the canvas size for which programs are compiled.

    Photographs from the internet have many sizes, and each size would need a compilation. Pairs
    that add the fewest pixels join first, until MOST_CANVASES are left. Further pairs join if they
    pad less than LEAST_PADDING.
    """
    counts = Counter(sizes)
    groups = [[size] for size in sorted(counts)]
    widths, heights = (np.array([size[k] for size in sorted(counts)]) for k in (0, 1))
    views = np.array([counts[size] for size in sorted(counts)])
    while len(groups) > 1:
        wider, higher = np.maximum.outer(widths, widths), np.maximum.outer(heights, heights)
        joined, area = wider * higher * np.add.outer(views, views), widths * heights * views
        added = joined - np.add.outer(area, area).astype(float)
        np.fill_diagonal(added, np.inf)
        one, other = sorted(map(int, np.unravel_index(np.argmin(added), added.shape)))
        if len(groups) <= MOST_CANVASES and added[one, other] > LEAST_PADDING * joined[one, other]:
            break
        widths[one], heights[one] = wider[one, other], higher[one, other]
        views[one] += views[other]
        groups[one] += groups.pop(other)
        widths, heights, views = (np.delete(a, other) for a in (widths, heights, views))
    canvas = zip(widths.tolist(), heights.tolist(), strict=True)
    return {size: place for group, place in zip(groups, canvas, strict=True) for size in group}


def bucket(needed: int, margin: float = 1.0) -> int:
    """Return a list length of at least `needed * margin`, in steps of 1.25: few programs exist."""
    length = SMALLEST
    while length < needed * margin:
        length = int(length * STEP) + 1
    return length


def until_it_fits(
    draw: Callable[[int], tuple[Result, Any, Any]], entries: int
) -> tuple[Result, int]:
    """Return a result and the capacity that sufficed; the tile list grows while it overflows.

    `draw` maps a static number of entries to (result, entries needed, whether they overflowed).
    """
    while True:
        result, needed, overflow = draw(entries)
        if not bool(overflow):
            return result, entries
        entries = _grown(entries, int(needed), PICTURES_GROWN)


def _grown(length: int, needed: int, margin: float) -> int:
    """Return a longer length if the list was too short, else the same."""
    return length if needed <= length else bucket(needed, margin)


class Capacity(NamedTuple):
    """Static sizes of a training step."""

    entries: int  # of the tile list
    visible: int  # Gaussians that one view may show

    def holds(self, other: Capacity) -> bool:
        """Return whether every view that fits the other capacity fits this one."""
        return self.entries >= other.entries and self.visible >= other.visible

    def grown(self, entries: int, visible: int) -> Capacity:
        """Return a capacity that fits a view with these counts; only a size too small grows."""
        return Capacity(
            _grown(self.entries, entries, TRAINING), _grown(self.visible, visible, VISIBLE_GROWN)
        )


count_needed = jax.jit(required_capacity, static_argnames="cfg")


@functools.cache
def compiled_renderer() -> Any:
    """Return `render_linear`, compiled; `cfg`, `capacity` and `with_depth` are static.

    It is made on first use, because its options depend on the backend, which an import should not
    start.
    """
    static = ("cfg", "capacity", "with_depth")
    return jax.jit(render_linear, static_argnames=static, compiler_options=compiler_options())


def make_renderer(
    cfg: RenderConfig,
    owners: Int[np.ndarray, " n"] | None = None,
    sizes: Iterable[tuple[int, int]] = (),
) -> RenderView:
    """Return a function that renders one view, and grows its tile lists after an overflow.

    `owners` are the moving objects of the Gaussians. Views of the image `sizes` are rendered on
    their `canvases`, views of other sizes on their exact size.
    """
    owner = None if owners is None else on_device(owners, np.int32)
    canvas_of = canvases(sizes)
    capacities: dict[tuple[int, int], int] = {}

    def render_view(gaussians: Gaussians, alive: Bool[Array, " n"], camera: Camera) -> Render:
        width, height = camera.width, camera.height
        size = canvas_of.get((width, height), (width, height))
        camera = dataclasses.replace(camera, width=size[0], height=size[1])
        if size not in capacities:
            needed = int(count_needed(gaussians, alive, camera, cfg=cfg, owner=owner))
            capacities[size] = bucket(needed, PICTURES)

        def draw(entries: int) -> tuple[Render, Array, Array]:
            render = compiled_renderer()
            result = render(gaussians, alive, camera, cfg=cfg, capacity=entries, owner=owner)
            return result, result.count, result.overflow

        result, capacities[size] = until_it_fits(draw, capacities[size])
        if size == (width, height):
            return result
        images = {k: getattr(result, k) for k in ("linear", "alpha", "depth")}
        cut = jax.tree.map(lambda image: np.asarray(image)[:height, :width], images)
        return dataclasses.replace(result, **cut)

    return render_view
