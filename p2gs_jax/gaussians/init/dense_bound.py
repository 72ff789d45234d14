"""Whether a scene gets dense seeds beside its points, and how many."""

from __future__ import annotations

from p2gs_jax.config import FitConfig
from p2gs_jax.gaussians.init.dense import FEWEST_VIEWS
from p2gs_jax.gaussians.population import Coverage, default_max_gaussians
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.visibility import shown_share
from p2gs_jax.types import Scene

# Seeds may take this share of the bound on the population; the rest grows where it is needed.
DENSE_SHARE = 0.6
# Scenes with this share of the bound in seeds need no more.
ENOUGH_SEEDS = 0.5


def coverage_of(scene: Scene, store: ImageStore) -> Coverage:
    """Return how much of a scene its training views show; the largest counts."""
    sizes = [store.camera(i)[2:] for i in scene.train_indices]
    return Coverage(max(w * h for w, h in sizes), shown_share(scene.points, scene.training_views))


def seed_bound(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return the bound on the population that the seeds are measured by.

    Args:
        cfg: the bound, if it is given.
        seeds: points of the scene.
        coverage: by the training photographs.
    """
    given = cfg.densify.max_gaussians
    if isinstance(given, int):
        return given
    return default_max_gaussians(seeds, coverage, cfg.train)


def dense_limit(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return how many dense seeds a fit may start from.

    Args:
        cfg: the bound on the population and `init.dense_points`.
        seeds: that are there already.
        coverage: by the training photographs.
    """
    bound = seed_bound(cfg, seeds, coverage)
    room = bound - seeds
    wanted = cfg.init.dense_points
    if wanted is None:
        wanted = int(DENSE_SHARE * bound) - seeds
    elif not isinstance(cfg.densify.max_gaussians, int):
        room = wanted
    return max(0, min(wanted, room))


def wants_dense(scene: Scene, coverage: Coverage, cfg: FitConfig) -> bool:
    """Return whether the scene gets dense seeds.

    The baselines that splat display values get them as well: a comparison with them is about
    photometry, so all start from the same surfaces.
    """
    if cfg.init.dense == "off" or len(scene.train_indices) < FEWEST_VIEWS:
        return False
    seeds = min(len(scene.points), cfg.init.max_seeds)
    if dense_limit(cfg, seeds, coverage) == 0:
        return False
    bound = seed_bound(cfg, seeds, coverage)
    return cfg.init.dense == "on" or seeds < ENOUGH_SEEDS * bound
