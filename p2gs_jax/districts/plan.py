"""What is asked of a fit in blocks, refused where it cannot be had, and kept for `--resume`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.districts.cut import Cut
from p2gs_jax.errors import UserError
from p2gs_jax.types import Scene

PLAN = "plan.json"


def check_options(cfg: FitConfig) -> None:
    """Refuse options under which blocks would share nothing.

    Raises:
        UserError: exposures are learned with the Gaussians, or something moves.
    """
    p = cfg.photometry
    if p.start != "tracks" or p.appearance is not None:
        raise UserError(
            f"--blocks keeps exposures as they are solved for all photographs at once; the preset "
            f"{cfg.preset!r} learns them with the Gaussians, in each block on its own.",
            fix="use --preset robust, or fit without --blocks",
        )
    if cfg.loss.relative_exposure.weight is not None:
        raise UserError(
            "--blocks keeps exposures as they are solved: the relative-exposure loss has nothing "
            "to move.",
            fix="add --loss.relative-exposure.weight None, or fit without --blocks",
        )
    if cfg.dynamics.method == "vibration":
        raise UserError(
            "--blocks fits what stands still: Gaussians that move would cross from block to block.",
            fix="add --dynamics.method mask, or fit without --blocks",
        )


def check_scene(scene: Scene, cfg: FitConfig) -> None:
    """Refuse a scene whose moving objects are to be fitted.

    Raises:
        UserError: there are some.
    """
    if cfg.dynamics.method != "mask" and any(thing.moving for thing in scene.objects):
        raise UserError(
            f"--blocks fits what stands still, and things move in {scene.root}.",
            fix="add --dynamics.method mask, which leaves them out, or fit without --blocks",
        )


def write_plan(folder: Path, cut: Cut, asked: str) -> None:
    """Write how the scene is cut.

    Args:
        folder: of the blocks.
        cut: of the scene.
        asked: what `--blocks` was.
    """
    write_json(folder / PLAN, {"asked": asked, "cut": cut.to_dict()})


def read_plan(folder: Path, asked: str) -> Cut | None:
    """Return how a run that is resumed was cut, or None where it was not yet.

    Args:
        folder: of the blocks.
        asked: what `--blocks` is now.

    Raises:
        UserError: it was cut otherwise, or the file is broken.
    """
    path = folder / PLAN
    if not path.exists():
        return None
    try:
        saved: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        before, cut = saved["asked"], Cut.from_dict(saved["cut"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} cannot be read ({error}).",
            fix="start again in another folder with --out",
        ) from error
    if before != asked and asked != str(len(cut.blocks)):
        raise UserError(
            f"{folder.parent} was begun with --blocks {before} ({len(cut.blocks)} blocks).",
            fix=f"repeat --blocks {before}, or name another folder with --out",
        )
    return cut
