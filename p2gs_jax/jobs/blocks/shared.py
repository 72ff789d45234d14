"""The photometry of a whole scene, solved before the blocks are fitted, and stored for all jobs."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import atomic_write, readable, write_json
from p2gs_jax.core.progress import Reporter
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.seeds import cameras_radius, photographed_colors
from p2gs_jax.gaussians.shell import Sphere, sphere_behind
from p2gs_jax.jobs.blocks.cut import Cut, block_scene
from p2gs_jax.photometry.parameters import point_radiance
from p2gs_jax.pipeline.exposures import Exposures, solve_exposures
from p2gs_jax.pipeline.survey import decided_scale, near_depth, scale_notes, seen_depths
from p2gs_jax.run.decisions import Decisions, read_decisions
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Photometry, Scene

ARRAYS, DECISIONS = "shared.npz", "decisions.json"


@dataclasses.dataclass(frozen=True)
class Shared:
    """A scene or a block with the shared photometry, which has one gauge of radiance."""

    scene: Scene  # with colours of the points
    exposures: Exposures  # fixed, of the training views, on the host; has point radiances
    shell: Sphere  # the sphere of the background


def solve_shared(
    scene: Scene, store: ImageStore, cfg: FitConfig, reporter: Reporter, kept: Decisions | None
) -> Shared:
    """Solve the photometry of a scene; `kept` has the earlier decisions of a resumed run.

    UserError: seed points are random, or no point of a surface is seen by two photographs.
    """
    still = store.leaving_out(scene.objects, cfg.dynamics.margin).only_opaque()
    solved = solve_exposures(scene, still, cfg, reporter, kept=kept)
    if solved.selection is None:
        unseen = "no point is seen by two photographs"
        why = f"{scene.root}: {'seed points are random' if scene.random_seeds else unseen}, so the "
        why += "exposures of blocks cannot be compared."
        raise UserError(why, fix="fit it without --blocks, or with a structure-from-motion model")
    views = scene.training_views
    depth = near_depth(seen_depths(scene.points, views))
    scale = decided_scale(depth, cfg)
    decisions = dataclasses.replace(solved.decisions, **scale)
    resolved = decisions.resolve(cfg)
    if scene.point_colors is None:
        scene = photographed_colors(scene, still, solved.photometry, resolved)
    exposures = dataclasses.replace(
        solved,
        photometry=jax.tree.map(np.asarray, solved.photometry),
        decisions=decisions,
        observations=None,
        radiance=point_radiance(scene, solved.selection.solution, resolved),
        notes=(*scale_notes(scene, cfg, depth), *solved.notes),
    )
    radius = cameras_radius(views, scene.points)
    return Shared(scene, exposures, sphere_behind(views, scene.points, radius, cfg.init))


def write_shared(folder: Path, shared: Shared) -> None:
    """Write the shared photometry of the blocks."""
    write_json(folder / DECISIONS, shared.exposures.decisions.to_dict())
    p, colors = shared.exposures.photometry, shared.scene.point_colors
    arrays = {
        "exposures": p.raw_exposures,
        "gammas": p.raw_gammas,
        "radiance": shared.exposures.radiance,
        "shell": np.array([*shared.shell.middle, shared.shell.radius]),
    }
    if p.raw_white_balance is not None:
        arrays["white_balance"] = p.raw_white_balance
    if p.cameras is not None:
        arrays["cameras"] = np.array(p.cameras, np.int64)
    if colors is not None:
        arrays["point_colors"] = colors
    with atomic_write(folder / ARRAYS) as temporary:
        np.savez(temporary, **arrays)


def read_shared(folder: Path, scene: Scene, cfg: FitConfig) -> Shared:
    """Return the stored photometry of the blocks, and `scene` with the stored point colours.

    UserError: the files are broken, or of another scene.
    """
    path = folder / ARRAYS
    decisions = read_decisions(folder / DECISIONS)
    with readable(path, f"remove {folder} and fit again: exposures are solved anew"):
        with np.load(path, allow_pickle=False) as file:
            a = dict(file)
        if decisions is None:
            raise ValueError(f"{DECISIONS} is missing")
        photometry = Photometry(
            a["exposures"],
            a["gammas"],
            cfg.photometry.parameterization,
            a.get("white_balance"),
            tuple(a["cameras"].tolist()) if "cameras" in a else None,
        )
        shell = Sphere(a["shell"][:3], float(a["shell"][3]))
        radiance = a["radiance"]
    held = (len(radiance), len(a["exposures"]))
    now = (len(scene.points), len(scene.train_indices))
    if held != now:
        why = f"{scene.root} has {now[0]} points and {now[1]} training photographs, and had "
        why += f"{held[0]} and {held[1]} when its exposures were solved."
        fix = "restore the scene as it was, or start again in another folder with --out"
        raise UserError(why, fix=fix)
    if "point_colors" in a:
        scene = dataclasses.replace(scene, point_colors=a["point_colors"])
    return Shared(scene, Exposures(photometry, decisions, radiance=radiance), shell)


def block_of(shared: Shared, cut: Cut, number: int) -> tuple[Shared, int]:
    """Return a block as a separate scene: its training views, its points, then coarse points.

    The second result is the number of points inside the block.
    """
    scene, keep, inside = block_scene(shared.scene, cut, number)
    given, rows = shared.exposures, np.array(cut.blocks[number].views)
    cameras = given.photometry.cameras
    assert given.radiance is not None
    exposures = dataclasses.replace(
        given,
        photometry=dataclasses.replace(
            jax.tree.map(lambda a: a[rows], given.photometry),
            cameras=None if cameras is None else tuple(cameras[k] for k in rows),
        ),
        radiance=given.radiance[keep],
    )
    return Shared(scene, exposures, shared.shell), inside
