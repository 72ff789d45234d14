"""A cut covers space once and shares photographs evenly; a block has the views that see it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.seeds import camera_centers
from p2gs_jax.jobs.blocks.cut import (
    Block,
    Cut,
    Ground,
    block_scene,
    cut_scene,
    seen_points,
    split,
    thinned,
)
from p2gs_jax.types import Scene, Tracks, View

LENGTH = 100.0


def make_road(views=40, points=4000, seed=0, tracks=False, turned=0.0):
    """Return a road along x (or turned about z) with cameras that look across it at a wall."""
    rng = np.random.default_rng(seed)
    c, s = np.cos(turned), np.sin(turned)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    wall = np.stack(
        [rng.uniform(0, LENGTH, points), np.full(points, 5.0), rng.uniform(-1, 2, points)], 1
    )
    looks = np.array([[1, 0, 0], [0, 0, -1], [0, 1.0, 0]])  # z of the camera along y
    K = np.array([[50, 0, 50], [0, 50, 40], [0, 0, 1]], np.float32)
    made = []
    for k in range(views):
        center = np.array([LENGTH * (k + 0.5) / views, 0, 0])
        rotation = looks @ turn.T
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ turn @ center
        test = "test" if k % 8 == 7 else "train"
        made.append(View(f"{k:03d}.png", None, "0", viewmat, K, 100, 80, split=test))
    scene = Scene(None, "made", tuple(made), (wall @ turn.T).astype(np.float32), None)
    if not tracks:
        return scene
    seen = [
        (scene.train_indices[row], p) for row, found in enumerate(seen_points(scene)) for p in found
    ]
    view, point = np.array(seen).T
    return dataclasses.replace(
        scene, tracks=Tracks(view, point, np.zeros((len(view), 2), np.float32))
    )


@settings(max_examples=40, deadline=None)
@given(count=st.integers(1, 9), seed=st.integers(0, 99), height=st.sampled_from([0.0, 1.0, 100.0]))
def test_cells_cover_the_plane_once_and_are_equally_full(count, seed, height):
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 1, (90, 2)) * [100.0, height]
    cells = split(places, count)
    assert len(cells) == count
    held = [int(cell.holds(places).sum()) for cell in cells]
    assert sum(held) == len(places)
    assert max(held) - min(held) <= 3
    anywhere = rng.normal(0, 300, (500, 2))
    inside = np.stack([cell.holds(anywhere) for cell in cells])
    assert (inside.sum(0) == 1).all()
    for cell, mine in zip(cells, inside, strict=True):
        away = cell.distance(anywhere)
        assert (away[mine] == 0).all()
        assert (away[~mine] > 0).all()


def test_places_that_coincide_stay_together():
    places = np.repeat([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [50, 2, 2], axis=0)
    cells = split(places, 2)
    assert [int(c.holds(places).sum()) for c in cells] == [50, 4]
    with pytest.raises(UserError, match="show one place"):
        split(places[:50], 2)


@pytest.mark.parametrize("tracks", [False, True])
@pytest.mark.parametrize("turned", [0.0, 2.0])
def test_blocks_of_a_road_follow_it(tracks, turned):
    scene = make_road(tracks=tracks, turned=turned)
    cut = cut_scene(scene, 4)
    assert cut.neighbours() == [(0, 1), (1, 2), (2, 3)]
    centers = cut.ground.place(camera_centers(scene.training_views))
    for block in cut.blocks:
        # A view reaches 5 m to either side, at 45 degrees.
        distance = block.distance(centers)
        assert (distance[list(block.views)] <= cut.margin + 5.5).all()
        assert set(np.flatnonzero(distance == 0)) <= set(block.views)
    sizes = [len(block.views) for block in cut.blocks]
    assert max(sizes) <= 1.5 * min(sizes)
    names = {scene.training_views[k].name for block in cut.blocks for k in block.views}
    assert names == {view.name for view in scene.training_views}


def test_blocks_that_touch_in_a_corner_are_neighbours():
    ranges = (-np.inf, 0.0), (0.0, np.inf)
    blocks = [Block((u[0], v[0]), (u[1], v[1])) for u in ranges for v in ranges]
    cut = Cut(Ground(np.zeros(3), np.eye(3)[:2]), 1.0, tuple(blocks))
    assert cut.neighbours() == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


def test_too_many_blocks_are_refused_with_the_largest_number():
    scene = make_road(views=8)
    with pytest.raises(UserError, match=r"too few for 5[\s\S]*--blocks 3 or fewer"):
        cut_scene(scene, 5)
    with pytest.raises(UserError, match="whole number"):
        cut_scene(scene, 0)


@pytest.mark.parametrize("tracks", [False, True])
def test_a_block_has_all_its_points_and_few_around_it(tracks):
    scene = make_road(tracks=tracks, points=20_000)
    cut = cut_scene(scene, 4)
    found, keep, inside = block_scene(scene, cut, 1)
    near = cut.blocks[1].holds(cut.ground.place(found.points), cut.margin)
    assert near[:inside].all()
    assert not near[inside:].any()
    assert inside == cut.blocks[1].holds(cut.ground.place(scene.points), cut.margin).sum()
    np.testing.assert_array_equal(found.points, scene.points[keep])
    assert len(found.train_indices) == len(found.views) == len(cut.blocks[1].views)
    if tracks:
        # Every observation is still of the same point in the same view.
        names, known = [v.name for v in scene.views], scene.tracks
        pairs = set(zip(known.view_indices.tolist(), known.point_indices.tolist(), strict=True))
        view, point = found.tracks.view_indices[::50], found.tracks.point_indices[::50]
        for v, p in zip(view, point, strict=True):
            assert (names.index(found.views[v].name), keep[p]) in pairs


def test_points_far_away_are_fewer():
    points = np.random.default_rng(1).uniform(0, 1, (20_000, 3)) * [100.0, 10.0, 10.0]
    edges = [1, 10, 25, 50, 100]
    counts, _ = np.histogram(points[thinned(points, points[:, 0])][:, 0], edges)
    assert (np.diff(counts / np.diff(edges)) < 0).all()
