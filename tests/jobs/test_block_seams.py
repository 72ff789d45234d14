"""Seams: measured as large as they were made; blocks merged with every Gaussian once."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scene.helpers import make_view
from splats import gaussians_of

from p2gs_jax import Scene, UserError
from p2gs_jax.config import DataConfig, RenderConfig
from p2gs_jax.jobs.blocks.cut import Block, Cut, Ground
from p2gs_jax.jobs.blocks.seams import OPAQUE, measure_seams, merge_cores
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.harmonics import C0
from p2gs_jax.scene.pixels.store import ImageStore, camera_of

GROUND = Ground(np.zeros(3), np.eye(3)[:2])
INF = np.inf
CFG = RenderConfig(sh_degree=0)


@pytest.fixture(scope="module")
def two_views(tmp_path_factory):
    root = tmp_path_factory.mktemp("seams")
    black, places = np.zeros((48, 64, 3), np.uint8), [(-0.3 * k, 0, 0) for k in range(2)]
    views = (make_view(root / f"{k}.png", black, 40.0, at=at) for k, at in enumerate(places))
    return Scene(root, "made", tuple(views), np.zeros((1, 3), np.float32), None)


def halves(margin=1.0, views=(0, 1)):
    left = Block((-INF, -INF), (0.0, INF), views)
    return Cut(GROUND, margin, (left, Block((0.0, -INF), (INF, INF), views)))


def wall(log_radiance=0.0, depth=4.0, width=41):
    """Return a wall of Gaussians across x, all of one radiance."""
    x, y = np.meshgrid(np.linspace(-3, 3, width), np.linspace(-2, 2, 27))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], 1)
    sh = np.full((1, 3), log_radiance / C0)
    return gaussians_of(means, [1, 0, 0, 0], np.log(0.15), 4.0, sh)


def test_every_gaussian_is_kept_by_the_block_whose_core_holds_it():
    cut = halves()
    first, second = wall(1.0), wall(2.0)
    merged, counts = merge_cores(cut, [first, second])
    x = np.asarray(first.means)[:, 0]
    assert counts == [int((x < 0).sum()), int((x >= 0).sum())]
    assert sum(counts) == merged.capacity == first.capacity
    means, tone = np.asarray(merged.means), np.asarray(merged.sh)[:, 0, 0] * C0
    np.testing.assert_allclose(tone, np.where(means[:, 0] < 0, 1.0, 2.0), rtol=1e-6)
    assert {tuple(m) for m in means} == {tuple(m) for m in np.asarray(first.means)}


def test_blocks_with_empty_cores_are_refused():
    cut = halves()
    away = dataclasses.replace(wall(), means=wall().means + jnp.array([10.0, 0, 0]))
    with pytest.raises(UserError, match="no block has a Gaussian"):
        merge_cores(cut, [away, dataclasses.replace(away, means=-away.means)])


@pytest.mark.parametrize(
    ("stops", "farther", "light"),
    [(0.0, 0.0, 0.3), (0.1, 0.0, 0.3), (-0.25, 0.02, 0.3), (0.1, 0.0, -7.7)],
)
def test_a_seam_is_measured_with_its_true_steps(two_views, stops, farther, light):
    store = ImageStore(two_views.views, DataConfig())
    first = wall(light)
    second = wall(light + stops * np.log(2), depth=4.0 * (1 + farther))
    (seam,) = measure_seams(two_views, store, halves(), [first, second], CFG)
    assert seam.blocks == (0, 1)
    assert seam.views == 2
    assert seam.pixels > 100
    assert seam.step_stops == pytest.approx(stops, abs=0.01)
    assert seam.spread_stops == pytest.approx(abs(stops), abs=0.01)
    assert seam.step_depth == pytest.approx(farther, abs=0.002)


def test_radiance_is_compared_as_rendered(two_views):
    """A block that shows 6 % of the background has Gaussians that are 6 % brighter."""
    store, opaque, thin = ImageStore(two_views.views, DataConfig()), wall(0.3), wall(0.3)
    thin = dataclasses.replace(thin, opacity_logits=jnp.full_like(thin.opacity_logits, -0.5))
    render = make_renderer(CFG)
    full, less = (
        np.asarray(render(g, jnp.ones(g.capacity, bool), camera_of(store, 0)).alpha)
        for g in (opaque, thin)
    )
    ratio = np.median((full / less)[less > OPAQUE])
    assert ratio > 1.02
    thin = dataclasses.replace(thin, sh=wall(0.3 + np.log(ratio)).sh)
    (seam,) = measure_seams(two_views, store, halves(), [opaque, thin], CFG)
    assert seam.pixels > 100
    assert abs(seam.step_stops) < 0.3 * np.log2(ratio)


def test_a_boundary_that_no_view_shows_has_no_step(two_views):
    walls, store = [wall(0.1), wall(0.5)], ImageStore(two_views.views, DataConfig())
    (seam,) = measure_seams(two_views, store, halves(views=()), walls, CFG)
    assert (seam.views, seam.pixels, seam.step_stops) == (0, 0, None)
