"""Capacities of the static arrays of a view: allocate outside jit, check for overflow, grow.

Time depends on what a view needs, memory on the capacity: 54 bytes per entry (BUILD_NOTES, "Growth
and memory"). So capacities are generous, and overflows, which cost a compilation, are rare.
"""

from __future__ import annotations

from typing import NamedTuple

STEP = 1.25
SMALLEST = 4096


def bucket(needed: int, margin: float = 1.0) -> int:
    """Return a capacity for `needed`: one of few values, a factor of 1.25 apart."""
    room = SMALLEST
    while room < needed * margin:
        room = int(room * STEP) + 1
    return room


class Room(NamedTuple):
    """Static sizes of a training step.

    Attributes:
        entries: of the tile list.
        visible: Gaussians that one view may show.
    """

    entries: int
    visible: int

    def holds(self, other: Room) -> bool:
        """Return whether every view that fits the other fits this."""
        return self.entries >= other.entries and self.visible >= other.visible

    def grown(self, entries: int, visible: int) -> Room:
        """Return a room for a view that did not fit, with a margin."""
        return Room(
            self.entries if entries <= self.entries else bucket(entries, 1.5),
            self.visible if visible <= self.visible else bucket(visible, 1.2),
        )
