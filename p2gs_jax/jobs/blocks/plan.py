"""The plan of blocks: options that are refused, memory of blocks, and the plan for `--resume`."""

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
from p2gs_jax.jobs.blocks.cut import Cut, block_scene, cut_scene
from p2gs_jax.pipeline.preflight import memory_needed
from p2gs_jax.types import Scene

PLAN = "plan.json"
# Largest number of blocks that is tried.
MOST_BLOCKS = 256


def check_options(cfg: FitConfig) -> None:
    """Raise a UserError for options that do not allow shared exposures or static Gaussians."""
    p = cfg.photometry
    if p.start != "tracks" or p.appearance is not None:
        raise UserError(
            f"--blocks needs exposures that are solved once for all photographs, but the preset "
            f"{cfg.preset!r} learns them together with the Gaussians, separately in each block.",
            fix="use --preset robust, or fit without --blocks",
        )
    if cfg.loss.relative_exposure.weight is not None:
        why = "--blocks keeps the solved exposures fixed, so the relative-exposure loss cannot "
        why += "change them."
        fix = "add --loss.relative-exposure.weight None, or fit without --blocks"
        raise UserError(why, fix=fix)
    if cfg.dynamics.method == "vibration":
        raise UserError(
            "--blocks fits static scenes only: moving Gaussians would cross from block to block.",
            fix="add --dynamics.method mask, or fit without --blocks",
        )


def check_scene(scene: Scene, cfg: FitConfig) -> None:
    """Raise a UserError if moving objects of the scene would be fitted."""
    if cfg.dynamics.method != "mask" and any(thing.moving for thing in scene.objects):
        why = f"--blocks fits static scenes only, and {scene.root} has moving objects."
        fix = "add --dynamics.method mask, which leaves them out, or fit without --blocks"
        raise UserError(why, fix=fix)


def write_plan(folder: Path, cut: Cut, blocks: str) -> None:
    """Write the cut of a scene, and `blocks`, the value of `--blocks`."""
    write_json(folder / PLAN, {"asked": blocks, "cut": cut.to_dict()})


def read_plan(folder: Path, blocks: str) -> Cut | None:
    """Return the cut of a resumed run, or None if it has none.

    Raises a UserError if `blocks` is another number of blocks, or if the file is broken.
    """
    path = folder / PLAN
    if not path.exists():
        return None
    with readable(path, "start again in another folder with --out"):
        saved: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        before, cut = saved["asked"], Cut.from_dict(saved["cut"])
    if before != blocks and blocks != str(len(cut.blocks)):
        why = f"{folder.parent} was started with --blocks {before} ({len(cut.blocks)} blocks)."
        raise UserError(why, fix=f"repeat --blocks {before}, or name another folder with --out")
    return cut


def bytes_needed(scene: Scene, cfg: FitConfig) -> float:
    """Return the peak memory, bytes, of the fit of a scene or of a block."""
    return memory_needed(scene, cfg, coverage_of(scene, cfg.data.max_width)).total


def largest_block(scene: Scene, cfg: FitConfig, cut: Cut) -> float:
    """Return the peak memory, bytes, of the block of a cut that needs the most."""
    count, most = len(scene.train_indices), 0.0
    for number in range(len(cut.blocks)):
        block, _, inside = block_scene(scene, cut, number)
        options = block_config(cfg, cut, number, block, inside, train_views=count)
        most = max(most, bytes_needed(block, options))
    return most


def fewest_blocks(scene: Scene, cfg: FitConfig, parallel: int) -> int:
    """Return the number of blocks for the free memory, by `_fitting`; 1: the whole scene fits.

    The result is also 1 if free memory is unknown. UserError: no cut has small enough blocks.
    """
    room = left_to_process()
    if room is None or bytes_needed(scene, cfg) <= room:
        return 1
    count = _fitting(scene, cfg, parallel, room)
    if count is None:
        raise UserError(
            f"even the smallest blocks need more than the {room / 1e9:.1f} GB of free memory.",
            fix="lower --max-width, --gaussians or --data.cache-mb, or fit fewer blocks at a time "
            "with --jobs",
        )
    return count


def require_room(scene: Scene, cfg: FitConfig, cut: Cut, parallel: int) -> None:
    """Raise a UserError if `parallel` blocks at a time need more than the free memory."""
    room = left_to_process()
    if room is None:
        return
    most = largest_block(scene, cfg, cut)
    together = min(parallel, len(cut.blocks))
    if most * together <= room:
        return
    count = _fitting(scene, cfg, parallel, room)
    fits = "" if count is None else f"use --blocks {count}; or "
    fewer = "fit fewer blocks at a time with --jobs; or " if together > 1 else ""
    raise UserError(
        f"the largest of {len(cut.blocks)} blocks needs about {most / 1e9:.1f} GB of memory"
        f"{f', {together} at a time' if together > 1 else ''}, but {room / 1e9:.1f} GB are free.",
        fix=f"{fits}{fewer}lower --max-width, --gaussians or --data.cache-mb",
    )


def _fitting(scene: Scene, cfg: FitConfig, parallel: int, room: float) -> int | None:
    """Return the first number of blocks that fits, tried in steps of a factor 1.5, or None."""
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
