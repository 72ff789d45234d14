import dataclasses

import cv2
import numpy as np
import pytest
from moving_box import BOX_TO_WORLD, lens

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import ImageStore
from p2gs_jax.scene.drives.objects import MovingObjects, object_mask
from p2gs_jax.types import TrackedObject, View

WIDTH, HEIGHT = 160, 96
SIZE = (4.0, 2.0, 1.5)


def make_view(tmp_path, time=0.0, name="a.png"):
    path = tmp_path / name
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    K = lens().astype(np.float32)
    return View(name, path, "0", np.eye(4, dtype=np.float32), K, WIDTH, HEIGHT, time=time)


def thing(at, turn=0.0, *, moving=True, times=(0.0, 1.0), step=(0.0, 0.0, 0.0)):
    c, s = np.cos(turn), np.sin(turn)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = BOX_TO_WORLD @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    poses[:, :3, 3] = np.array(at) + np.array(times)[:, None] * np.array(step)
    return TrackedObject("1", "Car", SIZE, np.array(times), poses, moving)


def by_points(view, box, time=0.0, margin=0.15):
    """Return the mask of many points within the box, as a camera sees them."""
    rng = np.random.default_rng(0)
    local = rng.uniform(-1, 1, (400_000, 3)) * (np.array(SIZE) / 2 + margin)
    pose = box.poses[0] + (box.poses[-1] - box.poses[0]) * time
    points = local @ pose[:3, :3].T + pose[:3, 3]
    points = points[points[:, 2] > 0.1]
    xy = points[:, :2] / points[:, 2:] * view.K[[0, 1], [0, 1]] + view.K[:2, 2]
    xy = np.floor(xy[((xy >= 0) & (xy < [WIDTH, HEIGHT])).all(1)]).astype(int)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[xy[:, 1], xy[:, 0]] = True
    return mask


@pytest.mark.parametrize(
    "box",
    [
        thing((0.5, 0.3, 8.0), 0.4),
        thing((-4.0, 0.0, 6.0), -0.8),
        thing((3.0, 0.5, 2.0), 0.2),
        # The camera is beside it, and within its length: it reaches behind.
        thing((2.0, 0.2, 0.5), 1.5),
    ],
)
def test_a_mask_is_what_points_in_the_box_cover(tmp_path, box):
    view = make_view(tmp_path)
    mask, sampled = object_mask(view, [box], WIDTH, HEIGHT), by_points(view, box)
    assert mask.any()
    # Pixels count where their centre is inside; points cover those that they touch.
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert not (sampled & ~grown).any()
    # Near the camera there are gaps between points.
    closed = cv2.morphologyEx(sampled.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9)))
    shrunk = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert (shrunk & (closed == 0)).mean() < 2e-3


def test_only_what_moves_and_is_tracked_then(tmp_path):
    view = make_view(tmp_path)
    box = thing((0, 0, 8.0))
    assert object_mask(view, [box], WIDTH, HEIGHT).any()
    assert not object_mask(view, [dataclasses.replace(box, moving=False)], WIDTH, HEIGHT).any()
    later = dataclasses.replace(view, time=9.0)
    assert not object_mask(later, [box], WIDTH, HEIGHT).any()
    assert not object_mask(dataclasses.replace(view, time=None), [box], WIDTH, HEIGHT).any()
    assert not object_mask(view, [thing((0, 0, -8.0))], WIDTH, HEIGHT).any()
    assert not object_mask(view, [], WIDTH, HEIGHT).any()


def test_at_the_view_s_own_time_and_any_size(tmp_path):
    box = thing((-2, 0, 8.0), step=(4.0, 0, 0))
    view = make_view(tmp_path, time=0.75)
    mask = object_mask(view, [box], WIDTH, HEIGHT)
    assert (mask & by_points(view, box, 0.75)).sum() > 0.9 * mask.sum()
    columns = np.flatnonzero(mask.any(0))
    assert columns.mean() > WIDTH / 2
    half = object_mask(view, [box], WIDTH // 2, HEIGHT // 2)
    assert half.shape == (HEIGHT // 2, WIDTH // 2)
    assert half.mean() == pytest.approx(mask.mean(), rel=0.1)
    wider = object_mask(view, [box], WIDTH, HEIGHT, margin=0.5)
    assert (wider & mask).sum() == mask.sum() < wider.sum()


def test_stores_share_photographs_and_leave_out_boxes(tmp_path):
    view = make_view(tmp_path)
    box = thing((0.5, 0.3, 8.0))
    whole = ImageStore([view], DataConfig())
    without = whole.leaving_out([box, thing((3, 0, 8.0), moving=False)])
    mask = object_mask(view, [box], WIDTH, HEIGHT)
    np.testing.assert_array_equal(whole.get(0)[1], 1)
    np.testing.assert_array_equal(without.get(0)[1], ~mask)
    pixels, valid = without.stored(0)
    assert pixels is whole.stored(0)[0]
    np.testing.assert_array_equal(valid, ~mask)
    assert whole.cached_bytes == without.cached_bytes > 0
    again = ImageStore([view], DataConfig(), [box])
    np.testing.assert_array_equal(again.get(0)[1], ~mask)


def test_cameras_of_a_store_know_where_objects_are(tmp_path):
    views = [make_view(tmp_path, 0.5), make_view(tmp_path, None, "b.png")]
    box = thing((-2, 0, 8.0), step=(4.0, 0, 0), times=(0.0, 0.5))
    store = ImageStore(views, DataConfig())
    assert store.placement(0) is None
    moving = MovingObjects((box,))
    store = store.placing(moving)
    placement = store.placement(0)
    assert placement is not None
    np.testing.assert_allclose(placement.viewmats[0], box.poses[1], atol=1e-6)
    assert store.placement(1) is None
    # Half a second after its last pose it is gone.
    gone = moving.placement(np.eye(4), 1.0)
    assert gone.viewmats[0, 2, 3] == -1
