"""Masks of boxes that move, and image stores that leave their pixels out."""

import dataclasses

import cv2
import numpy as np
import pytest
from moving_box import BOX_TO_WORLD
from scene.helpers import make_view

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import ImageStore
from p2gs_jax.scene.drives.objects import object_mask
from p2gs_jax.types import TrackedObject

SIZE, WHOLE = (4.0, 2.0, 1.5), (160, 96)


def view_at(tmp_path, time=0.0, name="a.png"):
    return make_view(tmp_path / name, np.full(WHOLE[::-1], 128, np.uint8), f=110.0, time=time)


def thing(at, turn=0.0, *, moving=True, times=(0.0, 1.0), step=(0.0, 0.0, 0.0)):
    c, s = np.cos(turn), np.sin(turn)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = BOX_TO_WORLD @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    poses[:, :3, 3] = np.array(at) + np.array(times)[:, None] * np.array(step)
    return TrackedObject("1", "Car", SIZE, np.array(times), poses, moving)


def by_points(view, box, time=0.0, margin=0.15):
    """Return the mask of many points within the box, as a camera sees them."""
    local = np.random.default_rng(0).uniform(-1, 1, (400_000, 3)) * (np.array(SIZE) / 2 + margin)
    pose = box.poses[0] + (box.poses[-1] - box.poses[0]) * time
    points = local @ pose[:3, :3].T + pose[:3, 3]
    points = points[points[:, 2] > 0.1]
    xy = points[:, :2] / points[:, 2:] * view.K[[0, 1], [0, 1]] + view.K[:2, 2]
    xy = np.floor(xy[((xy >= 0) & (xy < WHOLE)).all(1)]).astype(int)
    mask = np.zeros(WHOLE[::-1], bool)
    mask[xy[:, 1], xy[:, 0]] = True
    return mask


# The last box reaches behind the camera.
@pytest.mark.parametrize(
    ("at", "turn"),
    [((0.5, 0.3, 8), 0.4), ((-4, 0, 6), -0.8), ((3, 0.5, 2), 0.2), ((2, 0.2, 0.5), 1.5)],
)
def test_a_mask_covers_the_pixels_of_points_in_the_box(tmp_path, at, turn):
    view, box = view_at(tmp_path), thing(at, turn)
    mask, sampled = object_mask(view, [box], *WHOLE), by_points(view, box)
    assert mask.any()
    # The mask has the pixels whose centre is inside; points mark every pixel that they touch.
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert not (sampled & ~grown).any()
    # Near the camera there are gaps between points.
    closed = cv2.morphologyEx(sampled.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9)))
    shrunk = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert (shrunk & (closed == 0)).mean() < 2e-3


def test_masks_cover_moving_boxes_at_the_time_of_the_view_at_any_size(tmp_path):
    box, view = thing((-2, 0, 8.0), step=(4.0, 0, 0)), view_at(tmp_path, time=0.75)
    mask = object_mask(view, [box], *WHOLE)
    assert (mask & by_points(view, box, 0.75)).sum() > 0.9 * mask.sum()
    assert np.flatnonzero(mask.any(0)).mean() > WHOLE[0] / 2
    half = object_mask(view, [box], 80, 48)
    assert half.shape == (48, 80)
    assert half.mean() == pytest.approx(mask.mean(), rel=0.1)
    wider = object_mask(view, [box], *WHOLE, margin=0.5)
    assert (wider & mask).sum() == mask.sum() < wider.sum()
    for other, boxes in (
        (view, [dataclasses.replace(box, moving=False)]),
        (dataclasses.replace(view, time=9.0), [box]),
        (dataclasses.replace(view, time=None), [box]),
        (view, [thing((0, 0, -8.0))]),
        (view, []),
    ):
        assert not object_mask(other, boxes, *WHOLE).any()


def test_stores_share_photographs_and_leave_out_boxes(tmp_path):
    view, box = view_at(tmp_path), thing((0.5, 0.3, 8.0))
    whole, mask = ImageStore([view], DataConfig()), object_mask(view, [box], *WHOLE)
    without = whole.leaving_out([box, thing((3, 0, 8.0), moving=False)])
    np.testing.assert_array_equal(whole.get(0)[1], 1)
    assert without.stored(0)[0] is whole.stored(0)[0]
    assert whole._photographs._bytes == without._photographs._bytes > 0
    for store in (without, ImageStore([view], DataConfig(), [box])):
        np.testing.assert_array_equal(store.get(0)[1], ~mask)
        np.testing.assert_array_equal(store.stored(0)[1], ~mask)
