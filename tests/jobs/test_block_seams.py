"""Seams: measured as large as they were made, levelled, and merged with every Gaussian once."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scene.helpers import make_view
from splats import gaussians_of

from p2gs_jax import Scene, UserError
from p2gs_jax.config import DataConfig, RenderConfig
from p2gs_jax.jobs.blocks import seams as measuring
from p2gs_jax.jobs.blocks.cut import OVERLAP, Block, Cut, Ground
from p2gs_jax.jobs.blocks.seams import INWARDS, level_seams, measure_seams, merge_cores, shifts
from p2gs_jax.render.harmonics import C0
from p2gs_jax.scene.pixels.store import ImageStore, camera_of

GROUND = Ground(np.zeros(3), np.eye(3)[:2])
INF = np.inf
CFG = RenderConfig(sh_degree=0)
REACH = INWARDS / OVERLAP  # for a margin of 1


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


@pytest.mark.parametrize(("stops", "farther"), [(0.0, 0.0), (0.1, 0.0), (-0.25, 0.02)])
def test_a_seam_is_measured_with_its_true_steps(two_views, stops, farther):
    store = ImageStore(two_views.views, DataConfig())
    first = wall(0.3)
    second = wall(0.3 + stops * np.log(2), depth=4.0 * (1 + farther))
    (seam,) = measure_seams(two_views, store, halves(), [first, second], CFG, slice(None))
    assert seam.blocks == (0, 1)
    assert seam.views == 2
    assert seam.pixels > 100
    assert seam.step_stops == pytest.approx(stops, abs=0.01)
    assert seam.spread_stops == pytest.approx(abs(stops), abs=0.01)
    assert seam.step_depth == pytest.approx(farther, abs=0.002)


def at(x, y=0.0):
    x, y = np.broadcast_arrays(x, y)
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)


def test_a_boundary_meets_half_way_and_nothing_jumps_or_reaches_far():
    x = np.linspace(-5, 5, 2001)
    first, second = (shifts(halves(), k, at(x), {(0, 1): 0.4}) for k in range(2))
    merged = np.where(x < 0, first, 0.4 + second)
    assert merged[1000] == pytest.approx(0.2)
    assert np.all(np.diff(merged) >= 0)
    assert np.diff(merged).max() < 0.4 * 2 * (x[1] - x[0]) / REACH
    assert np.all(merged[x < -REACH] == 0)
    assert np.all(merged[x > REACH] == 0.4)


def test_blocks_around_a_corner_agree_there():
    ranges = (-INF, 0.0), (0.0, INF)
    blocks = [Block((u[0], v[0]), (u[1], v[1]), (0, 1)) for u in ranges for v in ranges]
    cut, offsets = Cut(GROUND, 1.0, tuple(blocks)), np.array([0.0, 0.3, -0.2, 0.7])
    pairs = cut.neighbours()
    # Blocks that touch only in the corner are neighbours as well.
    assert pairs == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    steps = {(a, b): offsets[b] - offsets[a] for a, b in pairs}
    places = at(*np.random.default_rng(0).uniform(-1, 1, (2, 50)))
    found = [offsets[k] + shifts(cut, k, places, steps) for k in range(4)]
    np.testing.assert_allclose(found, np.broadcast_to(found[0], (4, 50)), atol=1e-12)
    assert found[0].min() > -0.2
    assert found[0].max() < 0.7


@pytest.mark.parametrize("radiance", ["exp", "linear"])
def test_the_remaining_step_is_measured_in_other_views(two_views, monkeypatch, radiance):
    seen = []
    monkeypatch.setattr(
        measuring, "camera_of", lambda store, index: seen.append(index) or camera_of(store, index)
    )
    values = {"exp": (0.3, 0.3 + 0.2 * np.log(2)), "linear": (0.5, 2**0.2 - 0.5)}
    first, second = (wall(v) for v in values[radiance])
    cfg = RenderConfig(sh_degree=0, radiance=radiance)
    store = ImageStore(two_views.views, DataConfig())
    levelled, (seam,) = level_seams(two_views, store, halves(), [first, second], cfg)
    assert seen == [0, 1]
    assert seam.views == 1
    assert seam.levelled_stops == pytest.approx(0.2, abs=0.005)
    assert seam.step_stops == pytest.approx(0, abs=0.005)
    merged, _ = merge_cores(halves(), levelled)
    values = np.asarray(merged.sh)[:, 0, 0] * C0
    tone = np.log2(values + 0.5) if radiance == "linear" else values / np.log(2)
    order = np.argsort(np.asarray(merged.means)[:, 0])
    assert np.abs(np.diff(tone[order])).max() < 0.02
    assert np.ptp(tone) > 0.15


def test_a_boundary_that_no_view_shows_has_no_step_and_stays(two_views):
    walls, store = [wall(0.1), wall(0.5)], ImageStore(two_views.views, DataConfig())
    levelled, (seam,) = level_seams(two_views, store, halves(views=()), walls, CFG)
    assert (seam.views, seam.pixels, seam.step_stops, seam.levelled_stops) == (0, 0, None, None)
    for before, after in zip(walls, levelled, strict=True):
        np.testing.assert_array_equal(before.sh, after.sh)
