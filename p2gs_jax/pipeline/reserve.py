"""How much of a time budget evaluation and files will take."""

from __future__ import annotations

from p2gs_jax.config import FitConfig
from p2gs_jax.evaluation.lpips import LpipsWeights
from p2gs_jax.evaluation.scores import is_drive
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.types import Scene


def seconds_to_finish(
    scene: Scene, cfg: FitConfig, lpips_weights: LpipsWeights | None, *, reference: bool
) -> float:
    """Return a guess of the seconds that evaluation and files will take.

    Args:
        scene: its views are judged.
        cfg: their size, and the budget, of which a quarter at most is kept.
        lpips_weights: whether LPIPS is computed, and on which network.
        reference: whether each view is compared with a reference photograph as well.
    """
    if cfg.train.budget_s is None:
        return 0.0
    pixels = 0
    for view in scene.views:
        width, height = size_at(view, cfg.data.max_width)
        pixels += width * height
    # Measured (BUILD_NOTES, "Reserve for evaluation"): programs, then every view, and every pixel.
    per_view, per_pixel = (0.13, 0.35e-6) if reference else (0.09, 0.25e-6)
    start, times = 6.0, 5 if reference else 2
    if is_drive(scene):
        # Parts of every view, and views from beside the way; LPIPS of static and moving pixels.
        start, per_view, times = start + 6.0, per_view + 0.1, 3 * times
    if lpips_weights is not None:
        # Under two protocols (three where views have gammas), and three more against a reference.
        per_pixel += times * lpips_weights.network.seconds_per_pixel
    return min(start + per_view * len(scene.views) + per_pixel * pixels, 0.25 * cfg.train.budget_s)
