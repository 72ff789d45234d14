"""Initialisation: Gaussians of a scene whose exposures are known."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Float32

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.core.streams import Stream
from p2gs_jax.gaussians import seeds as seeding
from p2gs_jax.gaussians.dense import DenseSeeds, dense_limit, dense_seeds, gaussians_of
from p2gs_jax.gaussians.matching import Tones, rough_tones
from p2gs_jax.gaussians.moving import Nodes, node_gaussians, nodes_radiance, with_vibration
from p2gs_jax.gaussians.posed import chosen
from p2gs_jax.gaussians.shell import find_shell, shell_gaussians
from p2gs_jax.photometry.calibrate import NUMBERS, Selection
from p2gs_jax.photometry.parameters import initial_appearance, initial_photometry, point_radiance
from p2gs_jax.pipeline.exposures import Exposures
from p2gs_jax.pipeline.survey import Survey
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.scene.pixels.store import camera_of
from p2gs_jax.train.exposure_loss import ColorPairs, color_pairs
from p2gs_jax.types import Camera, Gaussians, Params, Scene, View


@dataclass
class Prepared:
    """The state before the first optimisation step."""

    survey: Survey  # the scene before its exposures were known
    scene: Scene  # the same scene, whose points have colours
    params: Params  # initial parameters
    decisions: Decisions  # values that the scene decided
    cfg: FitConfig  # the user's options with `decisions` filled in
    owner: np.ndarray | None = None  # moving object of each Gaussian (`Population.owner`)
    selection: Selection | None = None  # model, exposures and their errors from the tracks
    pairs: ColorPairs | None = None  # corresponding observations
    notes: list[str] = field(default_factory=list)  # notes for the user

    def view(self, index: int) -> tuple[Camera, Float32[np.ndarray, "h w 3"], np.ndarray]:
        """Return the camera, the photograph (display values) and the mask of a view in the fit."""
        return camera_of(self.survey.fitted, index), *self.survey.fitted.get(index)


def expected(found: Survey, decisions: Decisions) -> Prepared:
    """Return an initial state with the shapes of the real one: black Gaussians, exposures of 1."""
    scene, cfg, views = found.scene, found.cfg, found.scene.training_views
    points = scene.points[found.seeds]
    black = seeding.gaussians_from_points(points, np.zeros_like(points), views, cfg)
    if found.shell is not None:
        far, scales = found.shell.points, found.shell.scales
        shell = seeding.gaussians_from_points(far, np.zeros_like(far), views, cfg, scales=scales)
        black = seeding.merge(black, shell)
    if found.vibrating:
        black = with_vibration(black, scene, cfg)
    owner = None
    if found.nodes is not None:
        black, owner = _with_nodes(
            black, found.nodes, np.zeros_like(found.nodes.points), views, cfg
        )
    resolved = decisions.resolve(cfg)
    photometry = initial_photometry(None, [v.camera for v in views], resolved)
    params = Params(black, photometry, initial_appearance(views, cfg))
    return Prepared(found, scene, params, decisions, resolved, owner)


def initialise(found: Survey, exposures: Exposures, reporter: Reporter | None = None) -> Prepared:
    """Return the initial state: Gaussians at the seeds of a scene whose exposures are known."""
    return_freed_memory()  # the solver of the exposures has freed much
    reporter, scene, nodes = reporter or Silent(), found.scene, found.nodes
    decisions = exposures.decisions
    if exposures.radiance is None:
        decisions = dataclasses.replace(decisions, **found.scale)
    cfg, views = decisions.resolve(found.cfg), scene.training_views
    photometry = jax.tree.map(on_device, exposures.photometry)
    added, shell = None, found.shell
    if found.dense:
        added = _matched(found, exposures, cfg, reporter)
        covering = np.concatenate([scene.points, added.points])
        shell = find_shell(views, covering, found.radius, found.init, found.sphere)
    if scene.point_colors is None:
        scene = seeding.photographed_colors(scene, found.still, photometry, cfg)
    radiance = exposures.radiance
    if radiance is None:
        solution = None if exposures.selection is None else exposures.selection.solution
        radiance = point_radiance(scene, solution, cfg)
    seeds, owner = found.seeds, None
    gaussians = gaussians_of(scene.points[seeds], radiance[seeds], added, views, cfg)
    if shell is not None:
        far = shell_gaussians(shell, scene, found.still, photometry, views, cfg)
        gaussians = seeding.merge(gaussians, far)
    if found.vibrating:
        gaussians = with_vibration(gaussians, scene, cfg)
    if nodes is not None:
        colors = nodes_radiance(nodes, scene, found.fitted, photometry, cfg)
        gaussians, owner = _with_nodes(gaussians, nodes, colors, views, cfg)
    gaussians, owner, thinned = _bounded(gaussians, owner, found.cfg)
    notes = [*found.scene.notes, *found.scale_notes, *exposures.notes, *found.seed_notes]
    notes += [] if nodes is None else nodes.notes
    notes += [] if added is None else [added.note()]
    notes += [] if shell is None else [shell.note()]
    notes += thinned
    if found.cfg.dynamics.method == "vibration" and not found.vibrating:
        notes.append("Views have no times: the whole scene is fitted as static.")
    for note in notes:
        if not note.startswith(NUMBERS):
            reporter.message(note)
    appearance = initial_appearance(views, cfg, lambda k: found.fitted.get(scene.train_indices[k]))
    return Prepared(
        found,
        scene,
        Params(gaussians, photometry, appearance),
        decisions,
        cfg,
        owner,
        selection=exposures.selection,
        pairs=color_pairs(exposures.observations, cfg),
        notes=notes,
    )


def _matched(found: Survey, exposures: Exposures, cfg: FitConfig, reporter: Reporter) -> DenseSeeds:
    scene = found.scene
    color = Tones(jax.tree.map(np.asarray, exposures.photometry), cfg.photometry)
    rough = rough_tones(exposures.observations, len(scene.training_views))
    return dense_seeds(
        scene,
        found.still,
        color if exposures.solved else rough,
        color,
        cfg,
        existing=scene.points[found.seeds],
        limit=dense_limit(found.cfg, len(found.seeds), found.coverage),
        on_view=lambda i, n: reporter.stage("Matching photographs", i, n),
    )


def _with_nodes(
    gaussians: Gaussians, nodes: Nodes, radiance: np.ndarray, views: list[View], cfg: FitConfig
) -> tuple[Gaussians, np.ndarray | None]:
    """Return Gaussians followed by Gaussians of moving objects, and the owner of each."""
    if not len(nodes.moving):
        return gaussians, None
    world = np.full(gaussians.capacity, -1, np.int32)
    owner = np.concatenate([world, nodes.owner])
    return seeding.merge(gaussians, node_gaussians(nodes, radiance, views, cfg)), owner


def _bounded(
    gaussians: Gaussians, owner: np.ndarray | None, cfg: FitConfig
) -> tuple[Gaussians, np.ndarray | None, list[str]]:
    """Return at most as many Gaussians as the options allow, their owners, and notes."""
    bound = cfg.densify.max_gaussians
    if bound is None or gaussians.capacity <= bound:
        return gaussians, owner, []
    kept = seeding.subsample(gaussians.capacity, bound, cfg.train.seed, Stream.SEED_GAUSSIANS)
    note = f"{gaussians.capacity} Gaussians were thinned to {bound} (--gaussians)."
    return chosen(gaussians, kept), None if owner is None else owner[kept], [note]
