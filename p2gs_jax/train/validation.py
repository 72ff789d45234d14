"""Held-out training views: which they are, and how well they are rendered."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.alignment import fit_exposure
from p2gs_jax.evaluation.scores import psnr
from p2gs_jax.photometry.display import develop, display_of_view
from p2gs_jax.photometry.mean import usual_display
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.objects import with_corrections
from p2gs_jax.train.views import TrainingViews
from p2gs_jax.types import Params, Population

FEWEST_VIEWS = 8
VIEWS_PER_PICK = 12
FEWEST_PICKS, MOST_PICKS = 2, 8

Judge = Callable[[Params, Population], float]


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
        own_exposures: compare under the view's exposure, gamma and white balance, which then must
            come from elsewhere than the optimisation; else under the mean ones and the one exposure
            that fits best, as for test views.
    """
    render, tone = make_renderer(cfg.render), cfg.photometry

    def judge(params: Params, population: Population) -> float:
        backdrop = views.store.backdrop_values
        small = jax.tree.map(np.asarray, dataclasses.replace(params, gaussians=None))
        taken_by = [views.store.views[i].camera for i in views.rows]
        scores = []
        for row in rows:
            photograph, mask = views.store.get(views.rows[row])
            (camera,) = with_corrections((views.camera(row, 1),), params.poses)
            shown = render(params.gaussians, population.alive, camera, population.owner)
            linear, alpha = shown.linear, shown.alpha
            transform = usual_display(small, taken_by, taken_by[row], tone)
            if own_exposures:
                own = display_of_view(small, row, tone)
                transform = dataclasses.replace(own, correction=transform.correction)
            else:
                matte = dataclasses.replace(transform, backdrop=backdrop).matte(alpha)
                how = (transform.capture, tone, transform.correction, matte)
                exposure = float(fit_exposure(linear, photograph, mask, *how))
                transform = dataclasses.replace(transform, exposure=exposure)
            transform = dataclasses.replace(transform, backdrop=backdrop)
            ldr = develop(linear, transform, alpha=alpha)
            scores.append(float(psnr(ldr, photograph, mask)))
        return float(np.mean(scores))

    return judge
