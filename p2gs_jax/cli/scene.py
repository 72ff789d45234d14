"""`scene`: what a folder holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from p2gs_jax.cli.shared import count_of
from p2gs_jax.config import DataConfig

if TYPE_CHECKING:
    from p2gs_jax.scene import survey as surveys

# Labels of boxes that are named; the rest is counted.
MOST_LABELS = 8


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
        console = stdout()
        console.print(_head(found), soft_wrap=True)
        console.print(_cameras(found))
        lacks = [f"It has no {', no '.join(found.lacks)}."] if found.lacks else []
        notes = () if found.scene is None else found.scene.notes
        for line in (*_measurements(found), *lacks, *notes):
            console.print(line, soft_wrap=True)
        return 0


def _head(found: surveys.Survey) -> str:
    photographs = count_of(found.photographs, "photograph")
    if found.scene is None:
        return (
            f"{found.root}: {photographs}, and nothing else. Their cameras are found by structure "
            "from motion when a fit starts."
        )
    cameras = count_of(len(found.cameras), "camera")
    text = f"{found.root} ({found.format}): {photographs} of {cameras}"
    if found.frames is not None:
        text += f" in {count_of(found.frames, 'frame')}"
    if found.seconds is not None:
        text += f", {found.seconds:.1f} s"
    if found.way is not None:
        text += f", {found.way:.1f} m driven"
    return text + "."


def _cameras(found: surveys.Survey):
    """Return a table, without columns that are empty."""
    from p2gs_jax.cli.tables import make_table

    columns = {
        "camera": [c.name for c in found.cameras],
        "photographs": [str(c.photographs) for c in found.cameras],
        "size": [f"{c.size[0]} x {c.size[1]}" for c in found.cameras],
        "focal length, px": ["" if c.focal is None else f"{c.focal:.0f}" for c in found.cameras],
        "across": ["" if c.across is None else f"{c.across:.0f} degrees" for c in found.cameras],
        "lens": [c.lens for c in found.cameras],
        "EXIF, EV": [f"{c.ev[0]:.1f} to {c.ev[1]:.1f}" if c.ev else "" for c in found.cameras],
        "own car": ["" if c.own_car is None else f"{c.own_car:.1%}" for c in found.cameras],
    }
    shown = {name: cells for name, cells in columns.items() if any(cells)}
    return make_table(tuple(shown), zip(*shown.values(), strict=True), plain=True)


def _measurements(found: surveys.Survey) -> list[str]:
    from p2gs_jax.scene.survey import labels_of

    scene, lines = found.scene, []
    if scene is None:
        return lines
    if found.missing:
        lines.append(f"{count_of(found.missing, 'photograph')} missing in these frames.")
    if found.sweeps:
        lines.append(f"{count_of(found.sweeps, 'LiDAR sweep')}.")
    elif len(scene.points):
        lines.append(f"{len(scene.points):,} points.")
    if scene.tracks is not None:
        lines.append(f"{len(scene.tracks.xy):,} observations of points.")
    labels = labels_of(scene)
    if labels:
        listed = ", ".join(
            f"{count} {label}" + (f" ({moving} moving)" if moving else "")
            for label, count, moving in labels[:MOST_LABELS]
        )
        rest = sum(count for _, count, _ in labels[MOST_LABELS:])
        moving = sum(moving for *_, moving in labels)
        lines.append(
            f"Boxes: {len(scene.objects)} tracked, {moving} moving: {listed}"
            + (f", and {rest} more." if rest else ".")
        )
    return lines
