"""What the host knows of a run between bursts."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from p2gs_jax.render.capacity import Room
from p2gs_jax.train.growth import Growth


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
        growth: how far automatic growth has come.
        looked_at: progress of the last look for what no static scene explains.
        looked_step: the step after which it was, 0: there was none.
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
    growth: Growth = field(default_factory=Growth)
    looked_at: float = 0.0
    looked_step: int = 0

    @classmethod
    def from_dict(cls, values: dict) -> HostState:
        """Return what a checkpoint holds; those of older versions know nothing of growth."""
        known = {f.name for f in fields(cls)}
        values = {k: v for k, v in values.items() if k in known}
        rooms = {size: Room(*room) for size, room in values.get("rooms", {}).items()}
        growth = Growth.from_dict(values.get("growth", {}))
        return cls(**{**values, "rooms": rooms, "growth": growth})
