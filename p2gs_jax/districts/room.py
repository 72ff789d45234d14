"""Memory of blocks, told before any is fitted, and into how many a scene must be cut for it."""

from __future__ import annotations

from p2gs_jax.config import FitConfig
from p2gs_jax.core.memory import left_to_process
from p2gs_jax.districts.block_job import block_config, shown_by
from p2gs_jax.districts.cut import Cut, cut_scene
from p2gs_jax.districts.part_of import whole_of
from p2gs_jax.errors import UserError
from p2gs_jax.pipeline.preflight import memory_needed
from p2gs_jax.types import Scene

# More blocks than this are not tried.
MOST_BLOCKS = 256


def bytes_needed(scene: Scene, cfg: FitConfig) -> float:
    """Return what a fit of a scene, or of a block as a scene, takes at its peak.

    Args:
        scene: views and points.
        cfg: of this fit.
    """
    return memory_needed(scene, cfg, shown_by(scene, cfg)).total


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

    Args:
        scene: views and points.
        cfg: of the whole.
        parallel: blocks at a time.

    Raises:
        UserError: no cut is small enough.
    """
    room = left_to_process()
    if room is None or bytes_needed(scene, cfg) <= room:
        return 1
    count = _fitting(scene, cfg, parallel, room)
    if count is None:
        raise UserError(
            f"memory for a block is short however the scene is cut: there are {_gb(room)}.",
            fix="lower --max-width, --gaussians or --data.cache-mb, or let fewer run at a time "
            "with --jobs",
        )
    return count


def require_room(scene: Scene, cfg: FitConfig, cut: Cut, parallel: int) -> None:
    """Refuse a cut whose blocks are too large for the memory there is.

    Args:
        scene: views and points.
        cfg: of the whole.
        cut: of the scene.
        parallel: blocks at a time.

    Raises:
        UserError: they are; says how many blocks would fit.
    """
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
        f"the largest of {len(cut.blocks)} blocks would take about {_gb(most)} of memory"
        f"{f', {together} at a time' if together > 1 else ''}, and there are {_gb(room)}.",
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


def _gb(size: float) -> str:
    return f"{size / 1e9:.1f} GB"
