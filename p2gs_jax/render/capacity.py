"""How much room a view gets: allocate outside jit, check for overflow, grow.

Time follows what a view needs, memory the room: 54 bytes an entry (BUILD_NOTES, "Growth and
memory"). So room is generous and an overflow, which costs a compilation, is rare.
"""

from __future__ import annotations

from typing import NamedTuple

STEP = 1.25
SMALLEST = 4096


def bucket(needed: int, margin: float = 1.0) -> int:
    """Return the room for `needed`: a power of 1.25, so that few programs exist."""
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
        """Return whether what fits the other fits this."""
        return self.entries >= other.entries and self.visible >= other.visible

    def grown(self, entries: int, visible: int) -> Room:
        """Return room for a view that did not fit, with some to spare."""
        return Room(
            self.entries if entries <= self.entries else bucket(entries, 1.5),
            self.visible if visible <= self.visible else bucket(visible, 1.2),
        )
