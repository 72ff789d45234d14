"""The second view of the relative-exposure loss."""

from __future__ import annotations

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.losses.relative_exposure import ColorPairs
from p2gs_jax.losses.total import SECOND_RENDER_FORMS, Partner
from p2gs_jax.train.views import TrainingViews

PAIRS_PER_STEP = 4096


def partner_at(
    step: int,
    index: int,
    shrink: int,
    views: TrainingViews,
    pairs: ColorPairs | None,
    cfg: FitConfig,
) -> Partner:
    """Return the partner of a step, as much of it as the reading of the loss needs.

    Args:
        step: its number.
        index: row of its view.
        shrink: factor by which images are shrunk.
        views: the training views.
        pairs: corresponding observations; some of them are drawn for every step.
        cfg: the reading, and the seed.
    """
    relative = cfg.loss.relative_exposure
    if relative.weight is None:
        return on_host(Partner, np.int32(0))
    other = views.partner_at(step, index)
    camera, drawn = None, None
    if relative.form in SECOND_RENDER_FORMS:
        camera = views.camera(other, shrink)
    elif relative.form == "observed_ldr" and pairs is not None:
        count = pairs.views_i.shape[0]
        rng = generator(cfg.train.seed, Stream.STEP_PAIRS, step)
        pick = rng.integers(0, count, min(PAIRS_PER_STEP, count))
        drawn = jax.tree.map(lambda a: np.asarray(a)[pick], pairs)
    return on_host(Partner, np.int32(other), camera, drawn)
