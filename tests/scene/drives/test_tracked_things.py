"""Tracks of all data sets: in order, each time once, moving or not."""

import numpy as np
import pytest

from p2gs_jax.scene.drives.objects import tracked


def poses_at(*xs: float) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(xs), 1, 1))
    poses[:, 0, 3] = xs
    return poses


def test_a_track_is_sorted_and_each_time_counts_once():
    thing = tracked("a", "Car", (4, 2, 1.5), [2.0, 1.0, 2.0, 3.0], poses_at(5, 4, 9, 6), None)
    np.testing.assert_array_equal(thing.times, [1, 2, 3])
    np.testing.assert_array_equal(thing.poses[:, 0, 3], [4, 5, 6])
    assert thing.size == (4.0, 2.0, 1.5)


@pytest.mark.parametrize(
    ("xs", "moves"), [((0, 0.4, -0.3, 0.2), False), ((0, 0.7, 1.4), True), ((0, 3, 0), True)]
)
def test_what_gets_away_from_where_it_was_moves(xs, moves):
    thing = tracked("a", "Car", (4, 2, 1.5), np.arange(len(xs)), poses_at(*xs), None)
    assert thing.moving is moves


def test_what_the_set_says_counts_more():
    assert tracked("a", "Car", (4, 2, 1.5), [0.0], poses_at(0), True).moving
    assert not tracked("a", "Car", (4, 2, 1.5), [0.0, 1.0], poses_at(0, 9), False).moving
