"""Seams on a scene that can be written down: a textured plane before two cameras."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import LossConfig, PhotometryConfig
from p2gs_jax.evaluation.seams import (
    Photographed,
    camera_between,
    measure_seam,
    neighbouring_pairs,
    seam_picture,
)
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.types import Camera, Render, Scene, Tracks, View

SIZE, FOCAL, DEPTH = 64, 60.0, 4.0
TONE = PhotometryConfig()
COMMON = DisplayTransform(1.0, 2.2, TONE)


def camera(x: float) -> Camera:
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3] = -x
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], np.float32)
    return Camera(jnp.asarray(viewmat), jnp.asarray(K), SIZE, SIZE)


def radiance(x: float) -> np.ndarray:
    """The plane at z = DEPTH as a camera at (x, 0, 0) sees it."""
    v, u = (np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2) / FOCAL * DEPTH
    texture = 0.12 + 0.05 * np.sin(3 * (u + x)) + 0.04 * np.cos(4 * v)
    return np.stack([texture, 0.8 * texture, 1.1 * texture], -1).astype(np.float32)


def photographed(x: float, exposure: float, gamma: float = 2.2, claimed: float | None = None):
    ldr = np.rint(255 * develop(radiance(x), DisplayTransform(exposure, gamma, TONE))) / 255
    return Photographed(
        ldr.astype(np.float32),
        np.ones((SIZE, SIZE), np.float32),
        camera(x),
        np.full((SIZE, SIZE), DEPTH, np.float32),
        DisplayTransform(claimed or exposure, gamma, TONE),
    )


@pytest.mark.parametrize(
    ("second", "before", "left"),
    [
        ({"exposure": 1.6}, 1.0, 0.0),
        ({"exposure": 1.6, "claimed": 1.6 * 2**0.25}, 1.0, 0.25),
        ({"exposure": 0.8, "gamma": 2.8}, None, 0.0),
    ],
    ids=["a stop", "a wrong exposure", "a gamma of its own"],
)
def test_what_was_done_to_light_goes_when_photographs_are_developed_alike(second, before, left):
    found = measure_seam(photographed(0.0, 0.8), photographed(0.5, **second), COMMON, LossConfig())
    assert found is not None
    assert found.before_ev > 0.1
    if before is not None:
        assert found.before_ev == pytest.approx(before, abs=0.02)
        assert found.before_codes > 30
    assert found.after_ev == pytest.approx(left, abs=0.02)
    assert abs(found.step_ev) == pytest.approx(left, abs=0.02)
    if not left:
        assert found.after_codes < 1.5
    # The plane moves by FOCAL * 0.5 / DEPTH = 7.5 pixels: the rest is common.
    assert found.pixels == pytest.approx((SIZE - 7.5) * SIZE, rel=0.02)
    apart = photographed(9.0, 1.0)
    assert measure_seam(photographed(0.0, 1.0), apart, COMMON, LossConfig()) is None


def test_saturated_masked_and_hidden_pixels_do_not_count():
    first, second = photographed(0.0, 1.0), photographed(0.0, 1.0)
    full = measure_seam(first, second, COMMON, LossConfig())
    assert full is not None
    assert full.pixels == SIZE * SIZE
    ldr, mask, depth = first.ldr.copy(), second.mask.copy(), second.depth.copy()
    ldr[:8], mask[16:24], depth[40:48] = 1.0, 0.0, 0.5
    some = measure_seam(
        first._replace(ldr=ldr), second._replace(mask=mask, depth=depth), COMMON, LossConfig()
    )
    assert some is not None
    assert some.pixels == (SIZE - 24) * SIZE


def test_halves_lie_on_the_side_of_their_camera_and_match_when_developed_alike():
    first, second = photographed(0.5, 0.8), photographed(-0.5, 1.6)
    ones = jnp.ones((SIZE, SIZE))

    def render(camera):
        black, dead = jnp.zeros((SIZE, SIZE, 3)), jnp.zeros(0, bool)
        return Render(black, ones, DEPTH * ones, jnp.int32(0), jnp.array(False), dead)

    # The second photograph reaches farther left.
    picture = seam_picture(first, second, COMMON, render)
    assert not picture.left_first
    assert np.array_equal(seam_picture(second, first, COMMON, render).before, picture.before)
    middle = radiance(0.0)
    edge = SIZE // 2
    inner = slice(8, -8)
    for shown, columns, transform in (
        (picture.before, slice(edge + 1, -8), first.transform),
        (picture.before, slice(8, edge - 1), second.transform),
        (picture.after, inner, COMMON),
    ):
        expected = develop(middle, transform)[inner, columns]
        np.testing.assert_allclose(shown[inner, columns], expected, atol=0.02)


def test_halfway_turns_and_moves_half_as_far():
    c, s = np.cos(0.8), np.sin(0.8)
    turned = np.eye(4, dtype=np.float32)
    turned[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    turned[:3, 3] = -turned[:3, :3] @ [2, 0, 0]
    between = camera_between(
        camera(0.0), dataclasses.replace(camera(0.0), viewmat=jnp.asarray(turned))
    )
    viewmat = np.asarray(between.viewmat)
    np.testing.assert_allclose(-viewmat[:3, :3].T @ viewmat[:3, 3], [1, 0, 0], atol=1e-5)
    assert np.arctan2(viewmat[2, 0], viewmat[0, 0]) == pytest.approx(0.4, abs=1e-5)


def scene_of(names, cameras, seen, split=None):
    """Views of which each sees the points listed for it, by its tracks."""
    views = tuple(
        View(name, None, cam, np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32), 8, 8)
        for name, cam in zip(names, cameras, strict=True)
    )
    if split:
        views = tuple(dataclasses.replace(v, split=s) for v, s in zip(views, split, strict=True))
    rows = np.concatenate([np.full(len(points), i) for i, points in enumerate(seen)])
    tracks = Tracks(rows, np.concatenate(seen).astype(int), np.zeros((len(rows), 2), np.float32))
    count = 1 + max(map(max, seen))
    colors = np.zeros((count, 3), np.uint8)
    return Scene(None, "test", views, np.zeros((count, 3), np.float32), colors, tracks)


def test_a_rig_pairs_cameras_at_the_same_time():
    near, far = np.arange(0, 100), np.arange(200, 300)
    names = ["a/0.png", "a/1.png", "b/0.png", "b/1.png", "c/0.png"]
    scene = scene_of(names, list("aabbc"), [near, near, near, near, far])
    assert neighbouring_pairs(scene, 9) == [(0, 2), (1, 3)]
    assert neighbouring_pairs(scene, 1) == [(0, 2)]


def test_elsewhere_views_are_paired_with_those_they_share_most_with():
    seen = [np.arange(0, 100), np.arange(10, 110), np.arange(60, 160), np.arange(900, 910)]
    scene = scene_of(["0.png", "1.png", "2.png", "3.png"], ["x"] * 4, seen)
    assert neighbouring_pairs(scene, 9) == [(0, 1), (1, 2)]
    alike = scene_of(["0.png", "1.png", "2.png", "3.png"], ["x"] * 4, [np.arange(100)] * 4)
    assert neighbouring_pairs(alike, 9) == [(0, 1), (1, 2), (2, 3)]
    held_out = scene_of(
        ["0.png", "1.png", "2.png", "3.png"], ["x"] * 4, seen, ["train", "test", "train", "train"]
    )
    assert neighbouring_pairs(held_out, 9) == [(0, 2)]


def test_without_tracks_points_are_projected():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, (400, 2)), np.full((400, 1), 5.0)], 1)
    K = np.array([[60, 0, 32], [0, 60, 32], [0, 0, 1]], np.float32)

    def view(name, x):
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[0, 3] = -x
        return View(name, None, "x", viewmat, K, 64, 64)

    views = (view("0.png", 0.0), view("1.png", 3.65), view("2.png", 0.3))
    colors = np.zeros((400, 3), np.uint8)
    scene = Scene(None, "test", views, points.astype(np.float32), colors)
    assert (0, 2) in neighbouring_pairs(scene, 9)
    assert (0, 1) not in neighbouring_pairs(scene, 9)
