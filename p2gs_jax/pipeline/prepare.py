"""Everything before the first optimisation step: scene, exposures, radiances, Gaussians."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.core.streams import Stream
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.dense import (
    DenseSeeds,
    coverage_of,
    dense_limit,
    gaussians_of,
    match_photographs,
    wants_dense,
)
from p2gs_jax.gaussians.matching import Tones, rough_tones
from p2gs_jax.gaussians.moving import (
    Nodes,
    clock_of,
    find_nodes,
    node_gaussians,
    nodes_radiance,
    vibrates,
    with_vibration,
)
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.gaussians.seeds import (
    cameras_radius,
    merge,
    photographed_radiance,
    subsample,
    with_colors,
)
from p2gs_jax.gaussians.shell import black_gaussians, find_shell, shell_gaussians
from p2gs_jax.losses.relative_exposure import ColorPairs
from p2gs_jax.photometry.calibrate import Selection, calibrate_observations, options_of
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.parameters import initial_appearance, initial_photometry, point_radiance
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.sources.points import has_tracks, surface_colors
from p2gs_jax.pipeline.decide import decide, likely, with_choice
from p2gs_jax.pipeline.memory_needed import memory_needed, require_memory
from p2gs_jax.pipeline.part import Part
from p2gs_jax.pipeline.scale import (
    extent_of_rates,
    near_depth,
    near_plane,
    scale_notes,
    seen_depths,
)
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.train.compared_photographs import color_pairs
from p2gs_jax.train.measured_depths import measured_depths
from p2gs_jax.train.schedule import shrinks
from p2gs_jax.types import Gaussians, Measured, Params, Scene, View


@dataclass
class Prepared:
    """Everything known before the first optimisation step.

    Attributes:
        scene: views, points, tracks.
        store: photographs, whole; its cameras see what moves.
        fitted: the same photographs without the pixels that are left out of the fit.
        params: initial parameters.
        owner: the moving object that each Gaussian belongs to (`Population.owner`), or None.
        extent: what rates of the means are shares of, scene units.
        selection: photometric model, exposures and their errors from the tracks, or None.
        pairs: corresponding observations, or None.
        measured: of every training view the depths that the loss compares with, or None.
        coverage: how much of the scene the views show.
        decisions: what the scene settled.
        cfg: the options that the fit computes under: as asked, with `decisions` filled in.
        notes: what the user should know.
    """

    scene: Scene
    store: ImageStore
    fitted: ImageStore
    params: Params
    owner: np.ndarray | None
    extent: float
    selection: Selection | None
    pairs: ColorPairs | None
    measured: Sequence[Measured] | None
    coverage: Coverage
    decisions: Decisions
    cfg: FitConfig
    notes: list[str] = field(default_factory=list)


class Expected(NamedTuple):
    """What is known of a fit before its exposures: enough to compile for.

    Attributes:
        store: photographs.
        params: of the right shapes; the Gaussians are the scene's points, without colours.
        owner: the moving object that each belongs to, or None.
        extent: what rates of the means are shares of, scene units.
        coverage: how much of the scene the views show.
        decisions: what most scenes decide.
        cfg: the options under these.
        images: its tone curve is chosen.
        measured: of every training view the depths that the loss compares with, or None.
    """

    store: ImageStore
    params: Params
    owner: np.ndarray | None
    extent: float
    coverage: Coverage
    decisions: Decisions
    cfg: FitConfig
    images: bool
    measured: Sequence[Measured] | None


def load(scene_dir: Path, run_dir: Path, cfg: FitConfig, reporter: Reporter) -> Scene:
    """Read a scene of any known format and check that there is something to fit.

    Raises:
        UserError: it cannot be read, or has fewer than two training views or no seed points.
    """
    reporter.stage("Reading the scene")
    scene = load_scene(scene_dir, cfg.data, run_dir / "cache", reporter.message)
    if len(scene.train_indices) < 2:
        raise UserError(
            f"{scene_dir} has {len(scene.train_indices)} training view(s); a fit needs two.",
            fix="add photographs, or hold out fewer with --test-every 0",
        )
    if len(scene.points) == 0:
        raise UserError(
            f"{scene_dir} has no seed points.",
            fix="check the poses and that the photographs overlap",
        )
    held = len(scene.test_indices)
    reporter.message(f"Held out: {held} of {len(scene.views)} views ({scene.split_by}).")
    return scene


def prepare(
    scene: Scene,
    cfg: FitConfig,
    reporter: Reporter,
    clock: Stopwatch | None = None,
    on_expected: Callable[[Expected], None] = lambda expected: None,
    *,
    kept: Decisions | None = None,
    pixels: Path | None = None,
    part: Part | None = None,
) -> Prepared:
    """Start exposures, radiances and Gaussians from what the scene offers.

    Args:
        scene: from `load`.
        cfg: as asked.
        reporter: receives progress.
        clock: receives the seconds of `photometry` and `seeds`.
        on_expected: receives what can be told before the exposures are solved, where that is much.
        kept: what the checkpoints of a run that is resumed remember: its model and curve stay.
        pixels: folder for decoded photographs that are more than memory holds, or None.
        part: what was solved for a whole of which `scene` is a part, or None.

    Raises:
        UserError: there is not the memory for it, nothing to see, no room on the disk for
            decoded photographs, or two backgrounds.
    """
    clock = clock or Stopwatch()
    begin = time.monotonic()
    nodes = find_nodes(scene, cfg.dynamics)
    vibrating = vibrates(scene, cfg)
    moving = clock_of(scene) if vibrating else None if nodes is None else nodes.moving
    store = ImageStore(scene.views, cfg.data, moving=moving, folder=pixels)
    store.expect(shrinks(cfg.train))
    fitted, still = _without_what_moves(scene, store, nodes, cfg)
    _require_something_to_see(scene, fitted)
    views = scene.training_views
    taken_by = [view.camera for view in views]
    radius = cameras_radius(views, scene.points)
    depths = seen_depths(scene.points, views)
    extent = extent_of_rates(radius, depths, cfg)
    coverage = coverage_of(scene, store)
    require_memory(memory_needed(scene, cfg, coverage))
    measured = measured_depths(scene, cfg)
    dense = wants_dense(scene, coverage, cfg)
    seeds = _choose_points(scene, cfg)
    init = cfg.init
    behind = cfg.render.background is not None
    if store.backdrop is not None and behind:
        raise UserError(
            "render.background is light behind the splats, and the photographs' alpha shows "
            "data.background there.",
            fix="leave one of them out: --render.background None, or --data.alpha mask",
        )
    if (store.backdrop is not None or behind) and init.shell == "auto":
        # What lies behind everything is the background.
        init = dataclasses.replace(init, shell="off")
    depth = near_depth(depths)
    near = near_plane(depth, cfg)
    # Dense seeds cover some of what the points do not.
    sphere = None if part is None else part.shell
    shell = None if dense else find_shell(views, scene.points, radius, init, sphere)

    guess = likely(cfg, kept, matched=has_tracks(scene) or dense)
    guess = None if guess is None else dataclasses.replace(guess, near=near)
    if part is not None:
        guess = part.decisions
    expected: Expected | None = None
    if guess is not None:
        black = black_gaussians(scene.points[seeds.keep], shell, views, cfg)
        if vibrating:
            black = with_vibration(black, scene, cfg)
        owner = None
        if nodes is not None:
            colors = np.zeros_like(nodes.points)
            black, owner = _with_nodes(black, nodes, colors, views, cfg)
        params = Params(
            black,
            initial_photometry(None, taken_by, guess.resolve(cfg)),
            initial_appearance(views, cfg),
        )
        known = kept is not None or part is not None or not cfg.photometry.select
        under = guess.resolve(cfg)
        expected = Expected(fitted, params, owner, extent, coverage, guess, under, known, measured)
        on_expected(expected)

    def chosen(form: Form, response: Response) -> None:
        # What cameras do enters the programs, and is only solved now.
        if expected is None or form.vignetting is not None or response.by != "all":
            return
        told = with_choice(expected.decisions, form, response)
        under = told.resolve(cfg)
        start = initial_photometry(None, taken_by, under)
        params = dataclasses.replace(expected.params, photometry=start)
        on_expected(expected._replace(params=params, decisions=told, cfg=under, images=True))

    if part is None:
        tracks, selection, notes = solve(
            scene, still, cfg, reporter, chosen, dense=dense, kept=kept
        )
        matched = tracks is not None and len(tracks.points) > 0
        decisions = decide(cfg, selection, matched=matched, kept=kept)
        decisions = dataclasses.replace(decisions, near=near)
    else:
        tracks, selection, notes, decisions = None, None, [], part.decisions
    resolved = decisions.resolve(cfg)
    solution = None if selection is None else selection.solution
    photometry = initial_photometry(solution, taken_by, resolved)
    if part is not None:
        photometry = jax.tree.map(on_device, part.photometry)
    return_freed_memory()
    solved = time.monotonic()
    clock.add("photometry", solved - begin)

    added: DenseSeeds | None = None
    if dense:
        added = match_photographs(
            scene,
            still,
            rough_tones(tracks, len(views))
            if solution is None and part is None
            else Tones.of(photometry, resolved.photometry),
            scene.points[seeds.keep],
            photometry,
            resolved,
            limit=dense_limit(cfg, len(seeds.keep), coverage),
            on_view=lambda i, n: reporter.stage("Matching photographs", i, n),
        )
        covering = np.concatenate([scene.points, added.points])
        shell = find_shell(views, covering, radius, init, sphere)
    if scene.point_colors is None:
        scene = with_colors(scene, photographed_radiance(scene, still, photometry, resolved))
    radiance = point_radiance(scene, solution, resolved) if part is None else part.radiance
    gaussians = gaussians_of(scene.points[seeds.keep], radiance[seeds.keep], added, views, resolved)
    if shell is not None:
        far = shell_gaussians(shell, scene, still, photometry, views, resolved)
        gaussians = merge(gaussians, far)
    if vibrating:
        gaussians = with_vibration(gaussians, scene, resolved)
    owner = None
    if nodes is not None:
        found = nodes_radiance(nodes, scene, fitted, photometry, resolved)
        gaussians, owner = _with_nodes(gaussians, nodes, found, views, resolved)
    gaussians, owner, thinned = _bounded(gaussians, owner, cfg)
    notes = [*scene.notes, *scale_notes(scene, near, cfg, depth), *notes, *seeds.notes]
    notes += [] if nodes is None else nodes.notes
    notes += [] if added is None else [added.note()]
    notes += [] if shell is None else [shell.note()]
    notes += thinned
    if cfg.dynamics.method == "vibration" and not vibrating:
        notes.append("Views have no times: everything is fitted as if it stood still.")
    for note in notes:
        reporter.message(note)
    clock.add("seeds", time.monotonic() - solved)
    return Prepared(
        scene,
        store,
        fitted,
        Params(
            gaussians,
            photometry,
            initial_appearance(views, resolved, lambda k: fitted.get(scene.train_indices[k])),
        ),
        owner,
        extent,
        selection,
        color_pairs(tracks, resolved),
        measured,
        coverage,
        decisions,
        resolved,
        notes,
    )


def _require_something_to_see(scene: Scene, store: ImageStore) -> None:
    """Refuse masks that hide everything; of most scenes the first photograph is looked at."""
    if not any(store.stored(index)[1].any() for index in scene.train_indices):
        raise UserError(
            f"the masks hide every pixel of all {len(scene.train_indices)} training views.",
            fix="masks are black where pixels are to be ignored: invert them, or take them away",
        )


def _without_what_moves(
    scene: Scene, store: ImageStore, nodes: Nodes | None, cfg: FitConfig
) -> tuple[ImageStore, ImageStore]:
    """Return the photographs that are fitted, and those of what stands still and is opaque.

    Exposures and seeds come from the latter.
    """
    still = store.leaving_out(scene.objects, cfg.dynamics.margin)
    if cfg.dynamics.method == "mask":
        return still, still.only_opaque()
    left = () if nodes is None else nodes.left
    return store.leaving_out(left, cfg.dynamics.margin), still.only_opaque()


def _with_nodes(
    gaussians: Gaussians,
    nodes: Nodes,
    radiance: np.ndarray,
    views: list[View],
    cfg: FitConfig,
) -> tuple[Gaussians, np.ndarray | None]:
    """Return Gaussians with those of moving objects behind them, and to what each belongs."""
    if not len(nodes.moving):
        return gaussians, None
    world = np.full(gaussians.capacity, -1, np.int32)
    owner = np.concatenate([world, nodes.owner])
    return merge(gaussians, node_gaussians(nodes, radiance, views, cfg)), owner


class _Seeds(NamedTuple):
    """Which of the scene's points become seeds, and what to say of it."""

    keep: np.ndarray
    notes: list[str]


def _choose_points(scene: Scene, cfg: FitConfig) -> _Seeds:
    """Keep at most as many points as the options allow."""
    bound, most, option = cfg.densify.max_gaussians, cfg.init.max_seeds, "--init.max-seeds"
    if isinstance(bound, int) and bound <= most:
        most, option = bound, "--gaussians"
    keep = subsample(len(scene.points), most, cfg.train.seed)
    if len(keep) == len(scene.points):
        return _Seeds(keep, [])
    said = f"{len(scene.points)} seed points were thinned to {len(keep)} ({option})."
    return _Seeds(keep, [said])


def solve(
    scene: Scene,
    store: ImageStore,
    cfg: FitConfig,
    reporter: Reporter,
    on_chosen: Callable[[Form, Response], None],
    *,
    dense: bool,
    kept: Decisions | None,
) -> tuple[Observations | None, Selection | None, list[str]]:
    """Sample colours of shared points, and solve the photometry from them; both where possible.

    Args:
        scene: views, points, tracks.
        store: photographs of what stands still and is opaque.
        cfg: as asked.
        reporter: receives progress.
        on_chosen: receives the choice before it is solved.
        dense: the fit wants observations even where it starts from no exposures.
        kept: see `prepare`.
    """
    from_tracks = cfg.photometry.start == "tracks"
    if not (has_tracks(scene) or from_tracks or dense):
        return None, None, []
    notes = []
    if scene.random_seeds:
        notes = ["Seeds at random show nothing twice: exposures start at 1 and are learned."]
        return None, None, notes if from_tracks else []
    if not has_tracks(scene):
        notes.append("No tracks: seed points are projected into the views instead.")
    tracks = surface_colors(
        scene, store, cfg.train.seed, lambda i, n: reporter.stage("Sampling colours", i, n)
    )
    if not from_tracks:
        return tracks, None, notes
    if not len(tracks.points):
        notes.append(
            "No point is seen twice: exposures start at 1 and are learned from the first step."
        )
        return tracks, None, notes
    reporter.stage("Photometric bundle adjustment")
    under = cfg if kept is None else kept.resolve(cfg)
    selection = calibrate_observations(tracks, options_of(under, scene), on_chosen)
    if kept is not None:
        selection = dataclasses.replace(selection, reasons=kept.reasons)
    return tracks, selection, [*notes, *selection.reasons, *selection.solution.warnings]


def _bounded(
    gaussians: Gaussians, owner: np.ndarray | None, cfg: FitConfig
) -> tuple[Gaussians, np.ndarray | None, list[str]]:
    """Return at most as many Gaussians as the options allow, whose they are, and what to say."""
    bound = cfg.densify.max_gaussians
    if not isinstance(bound, int) or gaussians.capacity <= bound:
        return gaussians, owner, []
    kept = subsample(gaussians.capacity, bound, cfg.train.seed, Stream.SEED_GAUSSIANS)
    said = f"{gaussians.capacity} Gaussians were thinned to {bound} (--gaussians)."
    gaussians = jax.tree.map(lambda a: on_device(np.asarray(a)[kept]), gaussians)
    return gaussians, None if owner is None else owner[kept], [said]
