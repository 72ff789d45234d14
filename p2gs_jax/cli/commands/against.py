"""The part of `p2gs-jax eval` that sets other programs beside a run."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.core.atomic import write_json
from p2gs_jax.evaluation.against import check_renders, judge_renders, own_scores
from p2gs_jax.evaluation.evaluate import Judge
from p2gs_jax.evaluation.renders_of_others import OtherRenders, find_renders
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Scene

PROTOCOLS = {
    "averaged": "mean parameters",
    "as_rendered": "as rendered",
    "exposure_fitted": "exposure fitted to each photograph",
}
REFERENCE = {"as_rendered": "as rendered", "scale_aligned": "scale aligned"}
# Folders that do not say whose renders they hold.
COMMON = re.compile(r"renders|rgb|test|ours_\d+|\.")


def find_all(folders: Sequence[Path], scene: Scene, store: ImageStore) -> dict[str, OtherRenders]:
    """Return the renders of each program by its label; all were read once.

    Raises:
        UserError: see `find_renders` and `check_renders`.
    """
    labels = [_label(folder) for folder in folders]
    if len(set(labels)) < len(labels):
        labels = [str(folder) for folder in folders]
    return {
        label: check_renders(find_renders(folder, scene), scene, store)
        for label, folder in zip(labels, folders, strict=True)
    }


def _label(folder: Path) -> str:
    names = [n for n in Path(folder).resolve().parts if not COMMON.fullmatch(n)]
    return names[-1] if names else str(folder)


def judge_all(
    found: dict[str, OtherRenders],
    judge: Judge,
    metrics: dict[str, Any],
    on_progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Return what `against.json` holds (docs/files.md).

    Args:
        found: renders by program.
        judge: by what.
        metrics: of the run, as `metrics.json`.
        on_progress: views done, views in all.
    """
    programs = {}
    for label, renders in found.items():
        names = [judge.scene.views[row].name for row in sorted(renders.files)]
        programs[label] = {
            "folder": str(renders.folder),
            "layout": renders.layout,
            "views": len(names),
            "missing": list(renders.missing),
            **judge_renders(renders, judge, on_progress),
            "run": own_scores(metrics, names),
        }
    return {"version": 1, "programs": programs}


def report(
    path: Path, against: dict[str, Any], found: dict[str, OtherRenders], run: Path, metrics: dict
) -> None:
    """Write `against.json` and print it beside the run's scores.

    Args:
        path: of the file.
        against: from `judge_all`.
        found: renders by program.
        run: the run folder.
        metrics: of the run, as `metrics.json`.
    """
    write_json(path, against)
    console = stdout()
    table = Table(title="Held-out views, beside other programs", title_justify="left")
    for name in ("program", "protocol", "views", "PSNR dB", "SSIM", "LPIPS"):
        table.add_column(name, justify="left" if name in ("program", "protocol") else "right")

    def row(program: str, protocol: str, part: dict, views: int) -> None:
        lpips = f"{part['lpips']:.4f}" if "lpips" in part else "n/a"
        scores = (f"{part['psnr']:.2f}", f"{part['ssim']:.4f}", lpips)
        table.add_row(Text(program), protocol, str(views), *scores)

    own = Path(run).resolve().name + " (this run)"
    shown: list[int] = []
    for label, program in against["programs"].items():
        views = program["views"]
        # Once, unless programs lack different views.
        if program["missing"] or views not in shown:
            shown.append(views)
            for name, part in program["run"].items():
                row(own, PROTOCOLS[name], part, views)
            if "reference" in program and "reference" in metrics:
                part = metrics["reference"]["scale_aligned"]["test"]
                row(own, "reference, scale aligned", part, len(part["per_view"]))
        for name in ("as_rendered", "exposure_fitted"):
            row(label, PROTOCOLS[name], program[name], views)
        for name, part in program.get("reference", {}).items():
            row(label, f"reference, {REFERENCE[name]}", part, len(part["per_view"]))
    console.print(table)
    for renders in found.values():
        for remark in renders.remarks:
            console.print(Text(remark))
    console.print(Text(f"Results: {path}"))
