"""Between the controls and the rest of the viewer: what they need to know, and what they call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from p2gs_jax.viewer.settings import Settings


class PanelActions(Protocol):
    """What the controls call."""

    def display_changed(self) -> None:
        """Show the frame under the new settings."""
        ...

    def set_metered(self, metered: bool) -> None:
        """Let the exposure follow what is seen, or keep it where it is now."""
        ...

    def take_display_of(self, index: int | None) -> None:
        """Take all that a view was taken with, or the mean."""
        ...

    def mode_changed(self) -> None:
        """Show another mode."""
        ...

    def go_to(self, index: int) -> None:
        """Move to the camera of a view, and take its display transform unless that is locked."""
        ...

    def set_fov(self, degrees: float) -> None:
        """Set the vertical field of view."""
        ...

    def show_cameras(self, visible: bool, scale: float) -> None:
        """Show or hide the photographs' cameras, times their usual size."""
        ...

    def set_place(self, camera: str, place: float) -> None:
        """Move to a place on the drive of a camera."""
        ...

    def play(self, playing: bool) -> None:
        """Begin or stop playing along the drive."""
        ...

    def save(self, kind: str, width: int) -> None:
        """Send the view as a file."""
        ...


@dataclass(frozen=True)
class RunInfo:
    """What the controls need to know of a run.

    Attributes:
        names: of all views.
        cameras: physical cameras and how many views each has.
        start: initial settings.
        most_ev: largest distance of an exposure from the mean, stops.
        gammas: all that occur.
        curve: of the run.
        camera_legend: legend of the cameras' colours, HTML.
        most_balance_ev: largest gain of red or blue over green, stops; None where the run models
            no white balance.
        vignetting: whether any camera has it.
    """

    names: Sequence[str]
    cameras: dict[str, int]
    start: Settings
    most_ev: float
    gammas: Sequence[float]
    curve: str
    camera_legend: str
    most_balance_ev: float | None = None
    vignetting: bool = False
