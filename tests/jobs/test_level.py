"""Levelling takes out of a boundary what was measured there, and leaves what lies far from it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from walls import GROUND, INF, halves, wall

from p2gs_jax.config import DataConfig, RenderConfig
from p2gs_jax.jobs.blocks import seams as measuring
from p2gs_jax.jobs.blocks.cut import OVERLAP, Block, Cut
from p2gs_jax.jobs.blocks.seams import INWARDS, level_seams, merge_cores, shifts
from p2gs_jax.render.harmonics import C0
from p2gs_jax.scene.pixels.store import ImageStore, camera_of

REACH = INWARDS / OVERLAP  # of a margin of one


def at(x, y=0.0):
    x, y = np.broadcast_arrays(x, y)
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)


@given(step=st.floats(-2, 2), x=st.floats(-3, 3))
def test_two_blocks_come_out_alike_wherever_both_are_near(step, x):
    steps = {(0, 1): step}
    first, second = (shifts(halves(), k, at(x), steps)[0] for k in range(2))
    assert second + step - first == pytest.approx(0, abs=1e-12)


def test_a_boundary_meets_half_way_and_nothing_jumps_or_reaches_far():
    x = np.linspace(-5, 5, 2001)
    first, second = (shifts(halves(), k, at(x), {(0, 1): 0.4}) for k in range(2))
    merged = np.where(x < 0, first, 0.4 + second)
    assert merged[1000] == pytest.approx(0.2)
    assert np.all(np.diff(merged) >= 0)
    assert np.diff(merged).max() < 0.4 * 2 * (x[1] - x[0]) / REACH
    assert np.all(merged[x < -REACH] == 0)
    assert np.all(merged[x > REACH] == 0.4)


def quarters():
    """Return four blocks that meet in one corner."""
    ranges = (-INF, 0.0), (0.0, INF)
    blocks = [Block((u[0], v[0]), (u[1], v[1]), (0, 1)) for u in ranges for v in ranges]
    return Cut(GROUND, 1.0, tuple(blocks))


def test_blocks_around_a_corner_agree_there():
    cut, offsets = quarters(), np.array([0.0, 0.3, -0.2, 0.7])
    pairs = cut.neighbours()
    # Those that only touch in the corner as well.
    assert pairs == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    steps = {(a, b): offsets[b] - offsets[a] for a, b in pairs}
    places = at(*np.random.default_rng(0).uniform(-1, 1, (2, 50)))
    found = [offsets[k] + shifts(cut, k, places, steps) for k in range(4)]
    np.testing.assert_allclose(found, np.broadcast_to(found[0], (4, 50)), atol=1e-12)
    assert found[0].min() > -0.2
    assert found[0].max() < 0.7


def test_a_pair_that_was_not_measured_has_no_part():
    assert np.all(shifts(quarters(), 0, at(-0.1, -0.1), {(1, 3): 0.5}) == 0)


@pytest.mark.parametrize("radiance", ["exp", "linear"])
def test_what_is_left_is_measured_in_other_views(two_views, monkeypatch, radiance):
    seen = []
    monkeypatch.setattr(
        measuring, "camera_of", lambda store, index: seen.append(index) or camera_of(store, index)
    )
    values = {
        "exp": (0.3, 0.3 + 0.2 * np.log(2)),
        "linear": (0.5, 0.5 * 2**0.2 + 0.5 * (2**0.2 - 1)),
    }
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
    x = np.asarray(merged.means)[:, 0]
    order = np.argsort(x)
    assert np.abs(np.diff(tone[order])).max() < 0.02
    assert np.ptp(tone) > 0.15


def test_a_boundary_that_no_view_shows_is_left_as_it_is(two_views):
    first, second = wall(0.1), wall(0.5)
    cfg = RenderConfig(sh_degree=0)
    store = ImageStore(two_views.views, DataConfig())
    levelled, (seam,) = level_seams(two_views, store, halves(views=()), [first, second], cfg)
    assert (seam.step_stops, seam.levelled_stops) == (None, None)
    for before, after in zip((first, second), levelled, strict=True):
        np.testing.assert_array_equal(dataclasses.replace(before, sh=after.sh).sh, before.sh)
