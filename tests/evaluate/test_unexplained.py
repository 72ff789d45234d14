"""What no static scene explains is found where it is, and not where the fit is merely bad."""

import dataclasses

import cv2
import numpy as np
import pytest

from p2gs_jax.config import DataConfig
from p2gs_jax.evaluation.passes import ArrayStore
from p2gs_jax.evaluation.unexplained import Residuals, Unexplained, regions, residual_over_noise
from p2gs_jax.run.plots import MOST_PICTURES, marked, worst_rows, write_unexplained
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene, View

W, H, F, DEPTH = 160, 96, 100.0, 10.0
K = np.array([[F, 0, W / 2], [0, F, H / 2], [0, 0, 1]], np.float32)
RNG = np.random.default_rng(1)


def view_at(k, camera="front"):
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3] = -0.2 * k  # moves right, two pixels a frame
    name = f"{camera}/{k:02d}.png"
    return View(name, None, camera, viewmat, K, W, H, frame=k, time=0.1 * k)


def wall():
    """A wall wide enough for all views, smooth."""
    texture = cv2.GaussianBlur(RNG.random((H, 2 * W, 3)).astype(np.float32), (0, 0), 4)
    return 0.3 + 0.4 * (texture - texture.min()) / np.ptp(texture)


VIEWS = [view_at(k) for k in range(14)]
WALL = wall()
MOVER = (slice(40, 64), slice(70, 100))


def renders():
    return [WALL[:, 2 * k : 2 * k + W].copy() for k in range(len(VIEWS))]


def photographs(noise=0.01):
    """Photographs: noise; a badly fitted patch of the wall in all; what moves in the seventh."""
    out = []
    for k, render in enumerate(renders()):
        photograph = render + RNG.normal(0, noise, render.shape)
        photograph[70:90, 60 - 2 * k : 90 - 2 * k] += 0.3
        if k == 7:
            photograph[MOVER] = 0.05
        out.append(photograph.astype(np.float32))
    return out


def found_in(taken, skip=(), arrays=None):
    residuals = Residuals(VIEWS, arrays)
    depth = np.full((H, W), DEPTH, np.float32)
    mask = np.ones((H, W), np.float32)
    for k, (render, photograph) in enumerate(zip(renders(), taken, strict=True)):
        if k not in skip:
            residuals.add(k, render, photograph, mask, depth, K)
    return residuals.find()


def test_what_moves_is_found_and_a_bad_fit_is_not_also_where_views_wait_on_disk():
    with ArrayStore(0) as arrays:
        found = found_in(photographs(), arrays=arrays)
        assert arrays.bytes_held == 0
    moving = np.zeros((H, W), bool)
    moving[MOVER] = True
    both = (found[7].mask & moving).sum() / (found[7].mask | moving).sum()
    assert both > 0.85
    assert found[7].share == pytest.approx(found[7].mask.mean())
    # The bad patch has left the picture of the last views, and they do not know better.
    assert all(found[k].share < 0.01 for k in range(len(VIEWS)) if k != 7)


def test_noise_is_a_views_own_and_where_no_other_view_looks_the_residual_alone_counts():
    noisy = found_in(photographs(noise=0.05))
    assert all(found.share < 0.01 for k, found in noisy.items() if k != 7)
    assert noisy[7].share > 0.02
    alone = found_in(photographs(), skip=set(range(14)) - {0, 7})
    assert alone[7].share > 0.03
    assert alone[0].share > 0.02


def test_pixels_that_do_not_count_are_never_unexplained():
    render, photograph = np.zeros((20, 20, 3), np.float32), np.ones((20, 20, 3), np.float32)
    assert not residual_over_noise(render, photograph, np.zeros((20, 20), bool)).any()
    valid = np.zeros((20, 20), bool)
    valid[:, :4] = True
    assert not residual_over_noise(render, photograph, valid)[:, 4:].any()


def test_specks_are_no_regions():
    residual = np.zeros((60, 60), np.float32)
    residual[10:12, 10:12] = 50
    residual[30:45, 30:45] = 5
    assert not regions(residual, np.zeros_like(residual)).any()
    residual[37, 37] = 20
    assert regions(residual, np.zeros_like(residual))[30:45, 30:45].mean() > 0.9
    assert not regions(residual, residual).any()


def test_pictures_show_the_worst_of_each_camera_first(tmp_path):
    views = [view_at(k, camera) for camera in ("front", "back") for k in range(5)]
    scene = Scene(tmp_path, "pandaset", tuple(views), np.zeros((0, 3), np.float32), None)
    mask = np.zeros((H // 2, W // 2), bool)
    mask[10:20, 10:20] = True
    shares = [0.5, 0.4, 0.3, 0.0, 0.2, 0.01, 0.05, 0.0, 0.02, 0.0]
    found = {row: Unexplained(mask, share) for row, share in enumerate(shares)}
    rows = worst_rows(scene, found)
    assert rows == [0, 6, 1, 2, 4, 8]
    assert len(rows) == MOST_PICTURES
    stored = []
    for view in views:
        path = tmp_path / view.name
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.full((H, W, 3), 200, np.uint8))
        stored.append(dataclasses.replace(view, image_path=path))
    store = ImageStore(stored, DataConfig())
    write_unexplained(tmp_path / "unexplained", scene, store, found)
    written = (tmp_path / "unexplained").rglob("*.png")
    assert {p.relative_to(tmp_path / "unexplained").as_posix() for p in written} == {
        scene.views[row].name for row in rows
    }
    picture = marked(np.full((H, W, 3), 0.8, np.float32), mask)
    assert picture[30, 30, 0] > picture[30, 30, 1] + 0.1
    assert (picture[60, 60] == np.float32(0.8)).all()
    store.close()
