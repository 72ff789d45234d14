"""Capacities of the static arrays of a view: allocate outside jit, check for overflow, grow.

Time depends on what a view needs, memory on the capacity: 54 bytes per entry (BUILD_NOTES, "Growth
and memory"). So capacities are generous, and overflows, which cost a compilation, are rare.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from p2gs_jax.render.blocks import whole_blocks

STEP = 1.25
SMALLEST = 4096

Result = TypeVar("Result")


class Margins(NamedTuple):
    """How much longer than needed a list is made.

    Attributes:
        first: factor when it is allocated.
        grown: factor after an overflow.
    """

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
# Of training, whatever was counted.
ENTRIES_PER_GAUSSIAN, FEWEST_ENTRIES = 4, 16_384


def bucket(needed: int, margin: float = 1.0) -> int:
    """Return the length for `needed`: a power of 1.25, so that few programs exist."""
    length = SMALLEST
    while length < needed * margin:
        length = int(length * STEP) + 1
    return length


class TileCapacity(NamedTuple):
    """The length of a tile list.

    Attributes:
        entries: static size.
        margins: how much of it is to spare.
    """

    entries: int
    margins: Margins = PICTURES

    @classmethod
    def allocate(cls, needed: int, margins: Margins = PICTURES) -> TileCapacity:
        """Return the capacity for views that need so many entries, as counted."""
        return cls(bucket(needed, margins.first), margins)

    def holds(self, needed: int) -> bool:
        """Return whether so many entries fit."""
        return needed <= self.entries

    def grown(self, needed: int) -> TileCapacity:
        """Return the capacity for a view that overflowed; this one where it did not."""
        if self.holds(needed):
            return self
        return self._replace(entries=bucket(needed, self.margins.grown))


def until_it_fits(
    draw: Callable[[int], tuple[Result, Any, Any]], capacity: TileCapacity
) -> tuple[Result, TileCapacity]:
    """Draw, with a longer tile list as long as it overflows.

    Args:
        draw: from a static number of entries to (result, entries needed, whether they overflowed).
        capacity: to begin with.

    Returns:
        The result and the capacity that held it.
    """
    while True:
        result, needed, overflow = draw(capacity.entries)
        if not bool(overflow):
            return result, capacity
        capacity = capacity.grown(int(needed))


class Room(NamedTuple):
    """Static sizes of a training step.

    Attributes:
        entries: of the tile list.
        visible: Gaussians that one view may show.
    """

    entries: int
    visible: int

    @classmethod
    def allocate(cls, entries: int, visible: int, growth: float, limit: int) -> Room:
        """Return room for all views of one image size, to the end of a run.

        Args:
            entries: that a view needs at most now, as counted.
            visible: Gaussians that a view shows at most now.
            growth: factor by which the population may still grow; a view goes on to show the same
                share of it, and Gaussians that share a place are smaller.
            limit: the largest population to come.
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
        """Return room for a view that did not fit, with some to spare; only what was short grows.

        Args:
            entries: that the view needs.
            visible: Gaussians that it shows.
        """
        lists = TileCapacity(self.entries, TRAINING).grown(entries)
        shown = TileCapacity(self.visible, TRAINING_VISIBLE).grown(visible)
        return Room(lists.entries, shown.entries)
