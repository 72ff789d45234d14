"""One fit from a scene folder to a run folder: the data flow of ARCHITECTURE.md, top to bottom."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.config import to_dict as config_to_dict
from p2gs_jax.errors import UserError
from p2gs_jax.export.atomic import write_json
from p2gs_jax.init.observations import TrackColors, sample, sample_pairs, track_colors
from p2gs_jax.init.seeds import gaussians_from_points, merge, scene_extent, subsample
from p2gs_jax.init.shell import Shell, find_shell
from p2gs_jax.losses.total import OBSERVED_FORMS, TrackPairs
from p2gs_jax.photometry.formation import inverse_tone_map
from p2gs_jax.photometry.track_start import TrackStart, start_from_tracks
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.train.loop import LogRecord, Trainer, TrainResult
from p2gs_jax.train.views import TrainingViews
from p2gs_jax.types import GAMMA_SRGB, Gaussians, Params, Photometry, Scene

PAIR_POOL = 200_000
# Shell colours come from small images: a direction covers many pixels.
SHELL_SHRINK = 4
SHELL_OPACITY = 0.5


class Reporter(Protocol):
    """Where a fit says what it does."""

    def message(self, text: str) -> None:
        """Say something the user must know."""
        ...

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Begin or advance a stage."""
        ...

    def log(self, record: LogRecord) -> None:
        """Show the state of the optimisation."""
        ...


class Silent:
    """A reporter that says nothing."""

    def message(self, text: str) -> None:
        """Ignore."""

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Ignore."""

    def log(self, record: LogRecord) -> None:
        """Ignore."""


@dataclass
class Prepared:
    """Everything known before the first optimisation step.

    Attributes:
        scene: views, points, tracks.
        store: photographs.
        params: initial parameters.
        extent: scene extent, scene units.
        start: exposures from the tracks, or None.
        pairs: corresponding observations, or None.
        notes: what the user should know.
    """

    scene: Scene
    store: ImageStore
    params: Params
    extent: float
    start: TrackStart | None
    pairs: TrackPairs | None
    notes: list[str] = field(default_factory=list)


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
    return scene


def prepare(scene: Scene, cfg: FitConfig, reporter: Reporter) -> Prepared:
    """Start exposures, radiances and Gaussians from what the scene offers."""
    store = ImageStore(scene.views, cfg.data)
    views = [scene.views[i] for i in scene.train_indices]
    notes = list(scene.notes)
    extent = scene_extent(views, scene.points)
    tracks: TrackColors | None = None
    start: TrackStart | None = None
    if scene.tracks is not None and len(scene.tracks.xy):
        tracks = track_colors(
            scene, store, lambda i, n: reporter.stage("Sampling tracks", i, n)
        )
    if cfg.photometry.start == "tracks":
        if tracks is not None and len(tracks.points):
            start = start_from_tracks(
                tracks.views,
                tracks.points,
                tracks.colors,
                view_count=len(views),
                point_count=len(scene.points),
                cfg=cfg.photometry,
                loss=cfg.loss,
            )
            notes += start.warnings
        else:
            notes.append("No tracks: exposures start at 1 and are learned from the first step.")
    photometry = _photometry(start, len(views), cfg)
    keep = subsample(len(scene.points), cfg.init.max_seeds, cfg.train.seed)
    if len(keep) < len(scene.points):
        notes.append(
            f"{len(scene.points)} seed points were thinned to {len(keep)} (--init.max-seeds)."
        )
    points = scene.points[keep]
    radiance = _seed_radiance(scene, start, cfg)[keep]
    gaussians = gaussians_from_points(points, radiance, views, cfg)
    shell = find_shell(views, scene.points, extent, cfg.init)
    if shell is not None:
        gaussians = merge(
            gaussians, _shell_gaussians(shell, scene, store, photometry, views, cfg)
        )
        notes.append(
            f"{shell.empty_fraction:.0%} of the images look past every seed point: a far shell "
            f"of {len(shell.points)} Gaussians was added (--init.shell off leaves it out)."
        )
    for note in notes:
        reporter.message(note)
    pairs = _pairs(tracks, cfg)
    return Prepared(scene, store, Params(gaussians, photometry), extent, start, pairs, notes)


def _photometry(start: TrackStart | None, count: int, cfg: FitConfig) -> Photometry:
    p = cfg.photometry
    if start is not None:
        log_exposures = np.asarray(start.log_exposures)
    elif p.start == "random":
        draws = np.random.default_rng((cfg.train.seed, 3)).normal(1.0, p.start_std, count)
        log_exposures = np.log(np.maximum(draws, 0.1))
    else:
        log_exposures = np.zeros(count)
    if p.parameterization == "log":
        return Photometry(jnp.asarray(log_exposures, jnp.float32), jnp.zeros(count), "log")
    return Photometry(
        jnp.asarray(np.exp(log_exposures), jnp.float32), jnp.full((count,), GAMMA_SRGB), "linear"
    )


def _linearize(colors: np.ndarray, cfg: FitConfig) -> np.ndarray:
    return np.asarray(
        inverse_tone_map(jnp.asarray(colors, jnp.float32), jnp.float32(GAMMA_SRGB), cfg.photometry)
    )


def _seed_radiance(scene: Scene, start: TrackStart | None, cfg: FitConfig) -> np.ndarray:
    """Return linear radiance per seed: from the track start where it knows, else from colours."""
    radiance = _linearize(scene.point_colors.astype(np.float32) / 255.0, cfg)
    if start is not None:
        known = np.exp(start.point_log_radiance)
        radiance = np.where(np.isfinite(known), known, radiance)
    return radiance.astype(np.float32)


def _shell_gaussians(
    shell: Shell, scene: Scene, store: ImageStore, photometry: Photometry, views, cfg: FitConfig
) -> Gaussians:
    """Colour the shell by what the photographs show in its directions."""
    exposures = np.asarray(photometry.exposures)
    total = np.zeros((len(shell.points), 3))
    weight = np.zeros(len(shell.points))
    for row, index in enumerate(scene.train_indices):
        seen = np.flatnonzero(shell.seen[:, row])
        if not len(seen):
            continue
        ldr, mask = store.get(index, SHELL_SHRINK)
        view = scene.views[index]
        scale = [mask.shape[1] / view.width, mask.shape[0] / view.height]
        colors, valid = sample(ldr, mask, shell.xy[seen, row] * scale)
        total[seen[valid]] += _linearize(colors[valid], cfg) / exposures[row]
        weight[seen[valid]] += 1
    seen = weight > 0
    radiance = total[seen] / weight[seen, None]
    return gaussians_from_points(
        shell.points[seen],
        radiance.astype(np.float32),
        views,
        cfg,
        scales=shell.scales[seen],
        opacity=SHELL_OPACITY,
    )


def _pairs(tracks: TrackColors | None, cfg: FitConfig) -> TrackPairs | None:
    relative = cfg.loss.relative_exposure
    if relative.weight is None or relative.form not in OBSERVED_FORMS:
        return None
    if tracks is None or not len(tracks.points):
        raise UserError(
            f"the relative-exposure loss {relative.form!r} needs tracks, and this scene has none.",
            fix="choose another --loss.relative-exposure.form, or a scene with tracks",
        )
    first, second = sample_pairs(tracks, PAIR_POOL, cfg.train.seed)
    return TrackPairs(
        jnp.asarray(tracks.colors[first]),
        jnp.asarray(tracks.colors[second]),
        jnp.asarray(tracks.views[first], jnp.int32),
        jnp.asarray(tracks.views[second], jnp.int32),
    )


def optimise(
    prepared: Prepared,
    run_dir: Path,
    cfg: FitConfig,
    reporter: Reporter,
    *,
    resume: bool,
    spent_s: float = 0.0,
    reserve_s: float = 0.0,
) -> TrainResult:
    """Run the optimisation, from the start or from the newest checkpoint.

    Args:
        prepared: from `prepare`.
        run_dir: where the log and checkpoints go.
        cfg: everything.
        reporter: receives progress.
        resume: continue from the newest checkpoint.
        spent_s: seconds of the budget that are already gone.
        reserve_s: seconds of the budget to keep for evaluation and files.
    """
    views = TrainingViews(prepared.store, prepared.scene.train_indices, cfg.train.seed)
    trainer = Trainer(
        cfg,
        views,
        prepared.extent,
        prepared.pairs,
        run_dir,
        on_log=reporter.log,
        on_message=reporter.message,
    )
    alive = jnp.ones(prepared.params.gaussians.capacity, bool)
    return trainer.run(prepared.params, alive, resume=resume, reserve_s=spent_s + reserve_s)


def compact(result: TrainResult) -> Params:
    """Return the parameters with only the live Gaussians, in slot order."""
    alive = np.flatnonzero(np.asarray(result.state.population.alive))
    params = result.state.params
    return dataclasses.replace(params, gaussians=jax.tree.map(lambda a: a[alive], params.gaussians))


@dataclass(frozen=True)
class FitResult:
    """What `fit` returns to a program.

    Attributes:
        params: the fit, live Gaussians only.
        scene: what it was fitted to.
        metrics: what `metrics.json` holds.
        run_dir: the run folder.
        start: exposures from the tracks, or None.
    """

    params: Params
    scene: Scene
    metrics: dict
    run_dir: Path
    start: TrackStart | None


def fit(
    scene_dir: str | Path,
    run_dir: str | Path,
    cfg: FitConfig | None = None,
    *,
    reference: str | Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> FitResult:
    """Fit a scene and write a run folder.

    Args:
        scene_dir: COLMAP model, transforms.json, or folder of photographs.
        run_dir: created; its contract is in docs/files.md.
        cfg: options; None takes the `robust` preset.
        reference: photographs of the same views under one common exposure.
        resume: continue after an interruption.
        reporter: receives progress.

    Raises:
        UserError: something the user can mend.
    """
    from p2gs_jax.finish import finish, load_reference

    cfg = cfg or FitConfig()
    reporter = reporter or Silent()
    scene_dir, run_dir = Path(scene_dir), Path(run_dir)
    begin = time.monotonic()
    check_run_dir(run_dir, resume)
    run_dir.mkdir(parents=True, exist_ok=True)
    scene = load(scene_dir, run_dir, cfg, reporter)
    truth = load_reference(reference, scene, cfg) if reference is not None else None
    write_json(
        run_dir / "config.json",
        {
            "scene": str(scene_dir),
            "reference": None if reference is None else str(reference),
            "fit": config_to_dict(cfg),
        },
    )
    prepared = prepare(scene, cfg, reporter)
    result = optimise(
        prepared,
        run_dir,
        cfg,
        reporter,
        resume=resume,
        spent_s=time.monotonic() - begin,
        reserve_s=_finish_estimate(scene, cfg),
    )
    params = compact(result)
    metrics = finish(
        params,
        prepared,
        run_dir,
        cfg,
        reporter,
        truth=truth,
        counts={
            "gaussians": params.gaussians.capacity,
            "seed_points": len(scene.points),
            "train_views": len(scene.train_indices),
            "test_views": len(scene.test_indices),
            "steps": result.host.step,
            "refused_densifications": result.host.refused,
            "tile_lists_grown": result.host.overflows,
        },
        seconds={
            "total_until_evaluation": time.monotonic() - begin,
            "optimisation": result.host.elapsed_s,
        },
    )
    return FitResult(params, scene, metrics, run_dir, prepared.start)


def _finish_estimate(scene: Scene, cfg: FitConfig) -> float:
    """Return a guess of the seconds that evaluation and files will take."""
    if cfg.train.budget_s is None:
        return 0.0
    pixels = 0.0
    for view in scene.views:
        shrink = min(1.0, (cfg.data.max_width or view.width) / view.width)
        pixels += view.width * view.height * shrink**2
    return min(8.0 + 1.2e-6 * pixels, 0.25 * cfg.train.budget_s)


def check_run_dir(run_dir: Path, resume: bool) -> None:
    """Refuse to overwrite a run that another configuration began.

    Raises:
        UserError: the folder holds a run and `resume` is not set, or is not a folder.
    """
    if run_dir.exists() and not run_dir.is_dir():
        raise UserError(f"{run_dir} is a file.", fix="name a folder with --out")
    if not resume and (run_dir / "config.json").exists():
        raise UserError(
            f"{run_dir} already holds a run.",
            fix="add --resume to continue it, or name another folder with --out",
        )
