"""`scene`: what a folder holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import count_of

if TYPE_CHECKING:
    from p2gs_jax.scene import survey as surveys


@dataclass(frozen=True)
class Survey:
    """Inspect a scene without fitting it: cameras, frames, LiDAR, boxes, and what is missing.

    Reads every format that can be fitted. Structure from motion is not started.

        p2gs-jax scene drive
        p2gs-jax scene drive --cameras front front_left --frames 0:40
    """

    SHORT_NAMES: ClassVar = ("drive", "cameras", "frames")
    scene: Annotated[Path, tyro.conf.Positional]
    """What a fit could be given."""
    data: DataConfig = field(default_factory=DataConfig)

    def execute(self) -> int:
        """Print what there is."""
        from p2gs_jax.cli.tables import stdout
        from p2gs_jax.core.progress import TerminalReporter
        from p2gs_jax.scene.survey import survey

        with TerminalReporter() as reporter:
            reporter.stage("Reading the scene")
            found = survey(self.scene, self.data, reporter.message)
        console, cameras = stdout(), count_of(len(found.cameras), "camera")
        photographs = count_of(found.photographs, "photograph")
        console.print(f"{self.scene} ({found.format}): {photographs} of {cameras}.", soft_wrap=True)
        console.print(_cameras(found))
        for line in found.sentences:
            console.print(line, soft_wrap=True)
        return 0


def _cameras(found: surveys.Survey):
    """Return a table, without columns that are empty."""
    from p2gs_jax.cli.tables import make_table

    columns = {
        "camera": [c.name for c in found.cameras],
        "photographs": [str(c.photographs) for c in found.cameras],
        "size": [f"{c.size[0]} x {c.size[1]}" for c in found.cameras],
        "focal length, px": ["" if c.focal is None else f"{c.focal:.0f}" for c in found.cameras],
        "lens": [c.lens for c in found.cameras],
        "EXIF, EV": [f"{c.ev[0]:.1f} to {c.ev[1]:.1f}" if c.ev else "" for c in found.cameras],
        "own car": ["" if c.own_car is None else f"{c.own_car:.1%}" for c in found.cameras],
    }
    shown = {name: cells for name, cells in columns.items() if any(cells)}
    return make_table(tuple(shown), zip(*shown.values(), strict=True), plain=True)
