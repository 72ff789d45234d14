"""Held-out views get the exposure that the training views' rule gives their renders."""

import numpy as np
import pytest

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluation.metered import MeteredViews
from p2gs_jax.evaluation.passes import ArrayStore
from p2gs_jax.photometry.metering import meter

KEY = 0.2


def picture(level):
    return np.full((12, 16, 3), level, np.float32), np.ones((12, 16), np.float32)


@pytest.mark.parametrize("metered", [True, False])
def test_scores_are_under_the_metered_exposure(metered):
    levels = np.exp2(np.random.default_rng(0).normal(-2, 1, 24))
    drawn = np.exp2(np.random.default_rng(3).normal(0, 1, 24))
    with ArrayStore() as arrays:
        views = MeteredViews(arrays)
        for k, level in enumerate(levels):
            views.add_training(f"{k}.png", meter(*picture(level)))
        linear, mask = picture(0.4)
        views.add_held_out(7, meter(linear, mask), linear, linear, mask)
        exposures = KEY / levels if metered else drawn
        found = views.fit(exposures, 2.2, PhotometryConfig())
        scores = views.scores(found, lambda name, image, e, *_: {"level": float(image.mean() * e)})
    if metered:
        assert scores[7]["level"] == pytest.approx(KEY, rel=1e-4)
        assert scores[7]["exposure"] == pytest.approx(KEY / 0.4, rel=1e-4)
    else:
        assert scores == {}
