"""How a scene is to be cut: options that are refused, memory of blocks, the plan for `--resume`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import readable, write_json
from p2gs_jax.core.memory import left_to_process
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.dense import coverage_of
from p2gs_jax.jobs.blocks.block import block_config
from p2gs_jax.jobs.blocks.cut import Cut, cut_scene, whole_of
from p2gs_jax.pipeline.preflight import memory_needed
from p2gs_jax.types import Scene

PLAN = "plan.json"
# More blocks than this are not tried.
MOST_BLOCKS = 256


def check_options(cfg: FitConfig) -> None:
    """Raise a UserError for options under which blocks would share nothing."""
    p = cfg.photometry
    if p.start != "tracks" or p.appearance is not None:
        raise UserError(
            f"--blocks keeps exposures as they are solved for all photographs at once; the preset "
            f"{cfg.preset!r} learns them with the Gaussians, in each block on its own.",
            fix="use --preset robust, or fit without --blocks",
        )
    if cfg.loss.relative_exposure.weight is not None:
        why = "--blocks keeps exposures as they are solved: the relative-exposure loss has nothing "
        why += "to move."
        fix = "add --loss.relative-exposure.weight None, or fit without --blocks"
        raise UserError(why, fix=fix)
    if cfg.dynamics.method == "vibration":
        raise UserError(
            "--blocks fits what stands still: Gaussians that move would cross from block to block.",
            fix="add --dynamics.method mask, or fit without --blocks",
        )


def check_scene(scene: Scene, cfg: FitConfig) -> None:
    """Raise a UserError where moving objects of a scene are to be fitted."""
    if cfg.dynamics.method != "mask" and any(thing.moving for thing in scene.objects):
        why = f"--blocks fits what stands still, and things move in {scene.root}."
        fix = "add --dynamics.method mask, which leaves them out, or fit without --blocks"
        raise UserError(why, fix=fix)


def write_plan(folder: Path, cut: Cut, asked: str) -> None:
    """Write how the scene is cut, and what `--blocks` was."""
    write_json(folder / PLAN, {"asked": asked, "cut": cut.to_dict()})


def read_plan(folder: Path, asked: str) -> Cut | None:
    """Return how a run that is resumed was cut, or None where it was not yet.

    UserError: it was cut otherwise than `asked` now, or the file is broken.
    """
    path = folder / PLAN
    if not path.exists():
        return None
    with readable(path, "start again in another folder with --out"):
        saved: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        before, cut = saved["asked"], Cut.from_dict(saved["cut"])
    if before != asked and asked != str(len(cut.blocks)):
        why = f"{folder.parent} was begun with --blocks {before} ({len(cut.blocks)} blocks)."
        raise UserError(why, fix=f"repeat --blocks {before}, or name another folder with --out")
    return cut


def bytes_needed(scene: Scene, cfg: FitConfig) -> float:
    """Return what a fit of a scene, or of a block as a scene, takes at its peak."""
    return memory_needed(scene, cfg, coverage_of(scene, cfg.data.max_width)).total


def largest_block(scene: Scene, cfg: FitConfig, cut: Cut) -> float:
    """Return the bytes that the most demanding block of a cut takes."""
    count, most = len(scene.train_indices), 0.0
    for number in range(len(cut.blocks)):
        block, _, own = whole_of(scene, cut, number)
        options = block_config(cfg, cut, number, block, own, train_views=count)
        most = max(most, bytes_needed(block, options))
    return most


def fewest_blocks(scene: Scene, cfg: FitConfig, parallel: int) -> int:
    """Return into how few blocks a scene must be cut for the memory there is; 1: it fits whole.

    Raises a UserError where no cut is small enough.
    """
    room = left_to_process()
    if room is None or bytes_needed(scene, cfg) <= room:
        return 1
    count = _fitting(scene, cfg, parallel, room)
    if count is None:
        raise UserError(
            f"memory for a block is short however the scene is cut: there are {room / 1e9:.1f} GB.",
            fix="lower --max-width, --gaussians or --data.cache-mb, or let fewer run at a time "
            "with --jobs",
        )
    return count


def require_room(scene: Scene, cfg: FitConfig, cut: Cut, parallel: int) -> None:
    """Raise a UserError where so many blocks at a time are too large for the memory there is."""
    room = left_to_process()
    if room is None:
        return
    most = largest_block(scene, cfg, cut)
    together = min(parallel, len(cut.blocks))
    if most * together <= room:
        return
    count = _fitting(scene, cfg, parallel, room)
    fits = "" if count is None else f"use --blocks {count}; or "
    alone = "let fewer run at a time with --jobs; or " if together > 1 else ""
    raise UserError(
        f"the largest of {len(cut.blocks)} blocks would take about {most / 1e9:.1f} GB of memory"
        f"{f', {together} at a time' if together > 1 else ''}, and there are {room / 1e9:.1f} GB.",
        fix=f"{fits}{alone}lower --max-width, --gaussians or --data.cache-mb",
    )


def _fitting(scene: Scene, cfg: FitConfig, parallel: int, room: float) -> int | None:
    """Return the fewest blocks, in steps of a half, that fit; None: none do."""
    count = 2
    while count <= MOST_BLOCKS:
        try:
            cut = cut_scene(scene, count)
        except UserError:
            return None
        if largest_block(scene, cfg, cut) * min(parallel, count) <= room:
            return count
        count = max(count + 1, count * 3 // 2)
    return None
