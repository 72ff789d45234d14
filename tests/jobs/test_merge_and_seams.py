"""Merging keeps every Gaussian once; a seam is measured as large as it was made."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from walls import halves, wall

from p2gs_jax.config import DataConfig, RenderConfig
from p2gs_jax.errors import UserError
from p2gs_jax.jobs.blocks.seams import measure_seams, merge_cores
from p2gs_jax.render.harmonics import C0
from p2gs_jax.scene.pixels.store import ImageStore


def test_every_gaussian_is_kept_by_the_block_whose_core_holds_it():
    cut = halves()
    first, second = wall(1.0), wall(2.0)
    merged, counts = merge_cores(cut, [first, second])
    x = np.asarray(first.means)[:, 0]
    assert counts == [int((x < 0).sum()), int((x >= 0).sum())]
    assert sum(counts) == merged.capacity == first.capacity
    means, tone = np.asarray(merged.means), np.asarray(merged.sh)[:, 0, 0] * C0
    np.testing.assert_allclose(tone, np.where(means[:, 0] < 0, 1.0, 2.0), rtol=1e-6)
    places = {tuple(m) for m in means}
    assert places == {tuple(m) for m in np.asarray(first.means)}


def test_nothing_in_any_core_is_said():
    cut = halves()
    away = dataclasses.replace(wall(), means=wall().means + jnp.array([10.0, 0, 0]))
    with pytest.raises(UserError, match="no block has a Gaussian"):
        merge_cores(cut, [away, dataclasses.replace(away, means=-away.means)])


@pytest.mark.parametrize(("stops", "farther"), [(0.0, 0.0), (0.1, 0.0), (-0.25, 0.02)])
def test_a_seam_is_measured_as_it_was_made(two_views, stops, farther):
    store = ImageStore(two_views.views, DataConfig())
    cfg = RenderConfig(sh_degree=0)
    first = wall(0.3)
    second = wall(0.3 + stops * np.log(2), depth=4.0 * (1 + farther))
    (seam,) = measure_seams(two_views, store, halves(), [first, second], cfg)
    assert seam.blocks == (0, 1)
    assert seam.views == 2
    assert seam.pixels > 100
    assert seam.step_stops == pytest.approx(stops, abs=0.01)
    assert seam.spread_stops == pytest.approx(abs(stops), abs=0.01)
    assert seam.step_depth == pytest.approx(farther, abs=0.002)


def test_a_boundary_that_no_view_shows_is_said(two_views):
    store = ImageStore(two_views.views, DataConfig())
    (seam,) = measure_seams(
        two_views, store, halves(views=()), [wall(), wall()], RenderConfig(sh_degree=0)
    )
    assert (seam.views, seam.pixels, seam.step_stops) == (0, 0, None)
