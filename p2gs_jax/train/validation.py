"""Held-out training views: which they are, and how well they are rendered."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from p2gs_jax.config import FitConfig
from p2gs_jax.errors import UserError
from p2gs_jax.evaluate.alignment import fit_exposure
from p2gs_jax.evaluate.metrics import psnr
from p2gs_jax.photometry.appearance import mean_correction
from p2gs_jax.photometry.formation import display, formation
from p2gs_jax.photometry.mean import mean_parameters
from p2gs_jax.render.host import make_renderer
from p2gs_jax.train.views import TrainingViews
from p2gs_jax.types import Params

FEWEST_VIEWS = 8
VIEWS_PER_PICK = 12
FEWEST_PICKS, MOST_PICKS = 2, 8

Judge = Callable[[Params, Bool[Array, " n"]], float]


def pick_validation(cameras: Sequence[str]) -> tuple[int, ...]:
    """Return which training views to judge growth by: one in twelve, at least 2, at most 8.

    Cameras take turns, and the k-th of m picks lies (k + 1/2) / m along its camera's views, so that
    picks are spread over cameras and time.

    Args:
        cameras: the physical camera of every training view, in the order of time within each.

    Returns:
        Rows, sorted.

    Raises:
        UserError: there are too few views to leave any out.
    """
    count = len(cameras)
    if count < FEWEST_VIEWS:
        raise UserError(
            f"--gaussians auto judges growth by training views that it leaves out, and needs "
            f"{FEWEST_VIEWS}; this scene has {count}.",
            fix="give a number (--gaussians N) or leave the option out, add photographs, or hold "
            "out fewer with --test-every",
        )
    picks = min(max(round(count / VIEWS_PER_PICK), FEWEST_PICKS), MOST_PICKS)
    names = sorted(set(cameras))
    rows = {name: [i for i, c in enumerate(cameras) if c == name] for name in names}
    chosen: set[int] = set()
    for k in range(picks):
        turn = k % len(names) if picks >= len(names) else int((k + 0.5) * len(names) / picks)
        own = rows[names[turn]]
        wanted = own[int((k + 0.5) / picks * len(own))]
        # Cameras with few views are soon used up: then the nearest view that is left.
        left = [i for i in own if i not in chosen] or [i for i in range(count) if i not in chosen]
        chosen.add(min(left, key=lambda i: abs(i - wanted)))
    return tuple(sorted(chosen))


def make_judge(
    views: TrainingViews, rows: Sequence[int], cfg: FitConfig, *, own_exposures: bool
) -> Judge:
    """Return a function that gives the mean PSNR of some training views as evaluation would, dB.

    They are rendered at the size that evaluation uses, whatever the level of the schedule.

    Args:
        views: the training views.
        rows: which of them.
        cfg: renderer and formation model.
        own_exposures: compare under the view's exposure and gamma, which then must come from
            elsewhere than the optimisation; else under the mean gamma and the one exposure that
            fits best, as for test views.
    """
    render = make_renderer(cfg.render)

    def judge(params: Params, alive: Bool[Array, " n"]) -> float:
        mean_gamma = jnp.float32(mean_parameters(params.photometry).gamma)
        scores = []
        for row in rows:
            camera = views.store.views[views.rows[row]].camera
            correction = mean_correction(params.appearance, camera)
            photograph, mask = views.store.get(views.rows[row])
            linear = render(params.gaussians, alive, views.camera(row, 1)).linear
            if own_exposures:
                gamma = params.photometry.gammas[row]
                exposure = params.photometry.exposures[row]
            else:
                gamma = mean_gamma
                exposure = fit_exposure(linear, photograph, mask, gamma, cfg.photometry, correction)
            ldr = display(formation(linear, exposure, gamma, cfg.photometry, correction))
            scores.append(float(psnr(ldr, photograph, mask)))
        return float(np.mean(scores))

    return judge
