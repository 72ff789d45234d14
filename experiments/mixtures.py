"""Mixtures of exposures: the LOM scenes were photographed in several, and each view draws one.

Photographs of a group have nearly one exposure, so their solved exposures should nearly agree.
"""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.core.atomic import atomic_folder

SEED, GROUPS, REFERENCE = 7, ("low", "high", "over_exp"), "high"


def mixture_groups(
    views: Sequence[str], groups: Sequence[str] = GROUPS, seed: int = SEED
) -> dict[str, str]:
    """Return which exposure each view gets: drawn in the order of the views' sorted names."""
    rng = random.Random(seed)
    return {view: rng.choice(groups) for view in sorted(views)}


def write_mixture(
    lom: Path, out: Path, groups: Sequence[str] = GROUPS, test: Sequence[str] = ()
) -> None:
    """Write a scene of `lom` whose views have one of several exposures each.

    Args:
        lom: a LOM scene: a folder of photographs per exposure, and `colmap_sparse`.
        out: gets `images/`, `sparse/0`, `reference/` (`high` under the same names) and
            `groups.json` (view -> exposure).
        groups: exposures to draw from.
        test: held-out views by their stems; without any, every eighth is held out.
    """

    def photographs(group: str) -> dict[str, Path]:
        return {f.stem: f for f in (lom / group).iterdir() if f.suffix.lower() == ".jpg"}

    files = {group: photographs(group) for group in {*groups, REFERENCE}}
    drawn = mixture_groups(list(files[REFERENCE]), groups)
    with atomic_folder(out) as folder:
        for name in ("images", "reference"):
            (folder / name).mkdir()
        shutil.copytree(lom / "colmap_sparse" / "0", folder / "sparse" / "0")
        for view, group in drawn.items():
            shutil.copy(files[group][view], folder / "images" / f"{view}.JPG")
            shutil.copy(files[REFERENCE][view], folder / "reference" / f"{view}.JPG")
        if test:
            lines = [f"{view}.JPG" for view in test]
            (folder / "sparse" / "0" / "test.txt").write_text("\n".join(lines) + "\n")
        (folder / "groups.json").write_text(json.dumps(drawn, indent=1))


def their_test_views(lom: Path) -> list[str]:
    """Return the stems of the views that the authors of a LOM scene hold out."""
    frames = json.loads((lom / "transforms_test.json").read_text())["frames"]
    return [Path(frame["file_path"]).stem for frame in frames]


def read_groups(scene: Path) -> dict[str, str]:
    """Return the group of each view; empty if the scene is not a mixture."""
    path = scene / "groups.json"
    return json.loads(path.read_text()) if path.is_file() else {}


def within_groups_ev(photometry: Mapping[str, Any], groups: Mapping[str, str]) -> float | None:
    """Return the RMS distance of exposures from the means of their groups, EV.

    Args:
        photometry: what `photometry.json` holds.
        groups: name of a view without its suffix -> group; empty: None is returned.
    """
    views = photometry.get("views", ())
    evs = {v["image"]: v["exposure_ev"] for v in views if v["exposure_ev"] is not None}
    found: dict[str, list[float]] = {}
    for name, ev in evs.items():
        if (group := groups.get(Path(name).stem)) is not None:
            found.setdefault(group, []).append(ev)
    off = [ev - np.mean(group) for group in found.values() for ev in group]
    return float(np.sqrt(np.mean(np.square(off)))) if off else None
