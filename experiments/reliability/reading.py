"""What trials do with a scene: read all of it, or fit it for a few steps."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from reliability.trials import NONSENSE, REFUSED

# Everything that reading needs, so that a forked child imports nothing.
from p2gs_jax.cli import main
from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError
from p2gs_jax.scene import find_scene, with_masks_and_split
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.drives.recording import Recording
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene

FIT = (
    *("--steps", "4", "--densify.max-gaussians", "200", "--render.sh-degree", "0"),
    *("--init.shell", "off", "--init.max-seeds", "100", "--max-width", "48"),
)


def command(*words: object) -> int:
    """Run the command line; return its code."""
    try:
        main([str(word) for word in words])
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1
    return 0


def read(root: Path) -> int:
    """Survey a scene on the command line, then read it as a fit does and decode every photograph.

    Scenes without points are not triangulated: only their poses and photographs are read.
    """
    code = command("inspect", root)
    if code:
        return code
    try:
        return _whole(root)
    except UserError as error:
        print(printable(f"p2gs-jax: error: {error}"), file=sys.stderr)
        return REFUSED


def _whole(root: Path) -> int:
    cfg = DataConfig()
    found = find_scene(root, cfg)
    if isinstance(found, Recording):
        return _swept(found)
    if not isinstance(found, Scene):
        return 0
    scene = with_masks_and_split(found, cfg)
    store = ImageStore(scene.views, cfg)
    for row in range(len(scene.views)):
        pixels, mask = store.get(row)
        if not (_finite(pixels, mask) and pixels.min() >= 0 and pixels.max() <= 1):
            return _nonsense(f"pixels of {scene.views[row].name}")
    store.close()
    cameras = [a for view in scene.views for a in (view.viewmat, view.K)]
    tracks = () if scene.tracks is None else (scene.tracks.xy,)
    if not _finite(scene.points, *cameras, *tracks):
        return _nonsense("cameras or points")
    return 0


def _swept(found: Recording) -> int:
    """Read the files of a drive that `inspect` does not open, as a fit does.

    All sweeps are read; a fit reads only those of the photographs' time.
    """
    for sweep in found.sweeps:
        sweep.read()
    scene = assemble(found, DataConfig(ego_mask=False, allow_missing=True), write_embedded=False)
    measured = () if scene.lidar is None else (scene.lidar.points, scene.lidar.times)
    poses = [view.viewmat for view in scene.views] + [o.poses for o in scene.objects]
    return 0 if _finite(scene.points, *measured, *poses) else _nonsense("poses or points")


def _finite(*arrays: np.ndarray) -> bool:
    return all(bool(np.isfinite(array).all()) for array in arrays)


def _nonsense(what: str) -> int:
    print(f"not finite, or out of range: {what}", file=sys.stderr)
    return NONSENSE


def fit_into(root: Path, run: Path) -> int:
    """Fit a scene for a few steps, into a folder that stays."""
    return command("fit", root, "--out", run, *FIT)
