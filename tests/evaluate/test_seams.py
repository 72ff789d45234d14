"""Seams on a scene that can be written down: a textured plane before two cameras."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import splats

from p2gs_jax.config import LossConfig, PhotometryConfig
from p2gs_jax.evaluation import seams
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.types import Render, Scene, Tracks, View

SIZE, FOCAL, DEPTH = 64, 60.0, 4.0
TONE = PhotometryConfig()
COMMON = DisplayTransform(1.0, 2.2, TONE)


camera = functools.partial(splats.camera, width=SIZE, height=SIZE, focal=FOCAL)


def radiance(x: float) -> np.ndarray:
    """The plane at z = DEPTH as a camera at (x, 0, 0) sees it."""
    v, u = (np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2) / FOCAL * DEPTH
    texture = 0.12 + 0.05 * np.sin(3 * (u + x)) + 0.04 * np.cos(4 * v)
    return np.stack([texture, 0.8 * texture, 1.1 * texture], -1).astype(np.float32)


def photographed(x: float, exposure: float, gamma: float = 2.2, claimed: float | None = None):
    ldr = np.rint(255 * develop(radiance(x), DisplayTransform(exposure, gamma, TONE))) / 255
    return seams.Photographed(
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
    found = seams.measure_seam(
        photographed(0.0, 0.8), photographed(0.5, **second), COMMON, LossConfig()
    )
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
    assert seams.measure_seam(photographed(0.0, 1.0), apart, COMMON, LossConfig()) is None


def test_saturated_masked_and_hidden_pixels_do_not_count():
    first, second = photographed(0.0, 1.0), photographed(0.0, 1.0)
    full = seams.measure_seam(first, second, COMMON, LossConfig())
    assert full is not None
    assert full.pixels == SIZE * SIZE
    ldr, mask, depth = first.ldr.copy(), second.mask.copy(), second.depth.copy()
    ldr[:8], mask[16:24], depth[40:48] = 1.0, 0.0, 0.5
    some = seams.measure_seam(
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
    picture = seams.seam_picture(first, second, COMMON, render)
    assert not picture.left_first
    assert np.array_equal(seams.seam_picture(second, first, COMMON, render).before, picture.before)
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
    viewmat = np.asarray(seams.camera_between(camera(0.0), camera(2.0, yaw=0.8)).viewmat)
    np.testing.assert_allclose(-viewmat[:3, :3].T @ viewmat[:3, 3], [1, 0, 0], atol=1e-5)
    assert np.arctan2(viewmat[2, 0], viewmat[0, 0]) == pytest.approx(0.4, abs=1e-5)


RIG = ("a/0.png", "a/1.png", "b/0.png", "b/1.png", "c/0.png")
ALONE = ("0.png", "1.png", "2.png", "3.png")
OVERLAP = ((0, 100), (10, 110), (60, 160), (900, 910))


@pytest.mark.parametrize(
    ("names", "seen", "held_out", "most", "pairs"),
    [
        # A rig pairs cameras at the same time.
        (RIG, [(0, 100)] * 4 + [(200, 300)], None, 9, [(0, 2), (1, 3)]),
        (RIG, [(0, 100)] * 4 + [(200, 300)], None, 1, [(0, 2)]),
        # Elsewhere views are paired with those that they share most with.
        (ALONE, OVERLAP, None, 9, [(0, 1), (1, 2)]),
        (ALONE, [(0, 100)] * 4, None, 9, [(0, 1), (1, 2), (2, 3)]),
        (ALONE, OVERLAP, 1, 9, [(0, 2)]),
    ],
)
def test_neighbours_are_those_of_a_moment_or_share_most_points(names, seen, held_out, most, pairs):
    pose, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    splits = ["test" if row == held_out else "train" for row in range(len(names))]
    views = tuple(
        View(name, None, name.rpartition("/")[0], pose, K, 8, 8, split=split)
        for name, split in zip(names, splits, strict=True)
    )
    rows = np.concatenate([np.full(end - start, i) for i, (start, end) in enumerate(seen)])
    points = np.concatenate([np.arange(*ends) for ends in seen])
    tracks = Tracks(rows, points, np.zeros((len(rows), 2), np.float32))
    place = np.zeros((1000, 3), np.float32)
    scene = Scene(None, "test", views, place, place.astype(np.uint8), tracks)
    assert seams.neighbouring_pairs(scene, most) == pairs


def test_without_tracks_points_are_projected():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, (400, 2)), np.full((400, 1), 5.0)], 1)
    seen = [camera(x) for x in (0.0, 3.65, 0.3)]
    views = tuple(
        View(f"{k}.png", None, "x", np.asarray(c.viewmat), np.asarray(c.K), SIZE, SIZE)
        for k, c in enumerate(seen)
    )
    scene = Scene(None, "test", views, points.astype(np.float32), np.zeros((400, 3), np.uint8))
    assert (0, 2) in seams.neighbouring_pairs(scene, 9)
    assert (0, 1) not in seams.neighbouring_pairs(scene, 9)
