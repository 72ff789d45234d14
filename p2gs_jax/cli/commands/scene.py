"""`p2gs-jax scene`."""

from __future__ import annotations

from rich.box import SIMPLE
from rich.table import Table

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.survey import Survey as Options
from p2gs_jax.cli.options.survey import resolve_survey
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.errors import UserError
from p2gs_jax.scene.survey import Survey, SurveyedCamera, draw_plan, labels_of, survey

# Labels of boxes that are named; the rest is counted.
MOST_LABELS = 8


def run(options: Options) -> int:
    """Print what there is, and draw it."""
    cfg = resolve_survey(options)
    with TerminalReporter() as reporter:
        reporter.stage("Reading the scene")
        found = survey(options.scene, cfg, reporter.message)
        if options.out is not None:
            if found.scene is None:
                raise UserError(
                    f"{options.scene} holds photographs alone: where they were taken is not known.",
                    fix="leave out --out; a fit finds their cameras",
                )
            reporter.stage("Drawing")
            draw_plan(options.out, found)
    console = stdout()
    for line in _head(found):
        console.print(line, soft_wrap=True)
    console.print(_cameras(found))
    for line in (*_measurements(found), *_remarks(found)):
        console.print(line, soft_wrap=True)
    if options.out is not None:
        console.print(f"From above: {options.out}", soft_wrap=True)
    return 0


def _head(found: Survey) -> list[str]:
    said = _count(found.photographs, "photograph")
    if found.scene is None:
        return [
            f"{found.root}: {said}, and nothing else. Their cameras are found by structure from "
            "motion when a fit starts."
        ]
    cameras = _count(len(found.cameras), "camera")
    said = f"{found.root} ({found.format}): {said} of {cameras}"
    if found.frames is not None:
        said += f" in {_count(found.frames, 'frame')}"
    if found.seconds is not None:
        said += f", {found.seconds:.1f} s"
    if found.way is not None:
        said += f", {found.way:.1f} {found.unit} driven"
    return [said + "."]


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _cameras(found: Survey) -> Table:
    """Return a table, without columns that are empty."""
    columns = {
        "camera": [c.name for c in found.cameras],
        "photographs": [str(c.photographs) for c in found.cameras],
        "size": [f"{c.size[0]} x {c.size[1]}" for c in found.cameras],
        "focal length, px": ["" if c.focal is None else f"{c.focal:.0f}" for c in found.cameras],
        "across": ["" if c.across is None else f"{c.across:.0f} degrees" for c in found.cameras],
        "lens": [c.lens for c in found.cameras],
        "EXIF, EV": [_exif(c) for c in found.cameras],
        "own car": ["" if c.own_car is None else f"{c.own_car:.1%}" for c in found.cameras],
    }
    table = Table(box=SIMPLE)
    for name, cells in columns.items():
        if any(cells):
            table.add_column(name, justify="left" if name in ("camera", "lens") else "right")
    for row in zip(*(cells for cells in columns.values() if any(cells)), strict=True):
        table.add_row(*row)
    return table


def _exif(camera: SurveyedCamera) -> str:
    return "" if camera.ev is None else f"{camera.ev[0]:.1f} to {camera.ev[1]:.1f}"


def _measurements(found: Survey) -> list[str]:
    scene = found.scene
    if scene is None:
        return []
    said = []
    if found.missing:
        said.append(f"{_count(found.missing, 'photograph')} missing in these frames.")
    if found.sweeps:
        said.append(f"{_count(found.sweeps, 'LiDAR sweep')}.")
    elif len(scene.points):
        said.append(f"{len(scene.points):,} points.")
    if scene.tracks is not None:
        said.append(f"{len(scene.tracks.xy):,} observations of points.")
    labels = labels_of(scene)
    if labels:
        listed = ", ".join(
            f"{count} {label}" + (f" ({moving} moving)" if moving else "")
            for label, count, moving in labels[:MOST_LABELS]
        )
        rest = sum(count for _, count, _ in labels[MOST_LABELS:])
        moving = sum(moving for *_, moving in labels)
        said.append(
            f"Boxes: {len(scene.objects)} tracked, {moving} moving: {listed}"
            + (f", and {rest} more." if rest else ".")
        )
    return said


def _remarks(found: Survey) -> list[str]:
    said = [f"It has no {', no '.join(found.lacks)}."] if found.lacks else []
    return said if found.scene is None else [*said, *found.scene.notes]
