"""What the host knows of a run between bursts."""

from __future__ import annotations

from dataclasses import dataclass, field

from p2gs_jax.render.capacity import Room


@dataclass
class HostState:
    """What the host remembers between bursts; saved with every checkpoint.

    Attributes:
        step: steps completed, a view each.
        progress: fraction of the run completed.
        pace: progress per step.
        elapsed_s: seconds of earlier sessions and of this one.
        densified_at: progress of the last densification.
        reset_at: progress of the last opacity reset.
        refused: densification requests that found no slot, summed.
        overflows: tile lists grown.
        rooms: room of a view for every "WxH".
        shrink: factor by which images are shrunk at the present level.
        step_s: running estimate of the seconds a step takes at this level, compiling apart; 0:
            none was timed yet.
    """

    step: int = 0
    progress: float = 0.0
    pace: float = 0.0
    elapsed_s: float = 0.0
    densified_at: float = 0.0
    reset_at: float = 0.0
    refused: int = 0
    overflows: int = 0
    rooms: dict[str, Room] = field(default_factory=dict)
    shrink: int = 0
    step_s: float = 0.0

    @classmethod
    def from_dict(cls, values: dict) -> HostState:
        """Return what a checkpoint holds."""
        return cls(**{**values, "rooms": {k: Room(*room) for k, room in values["rooms"].items()}})
