"""Panoramas of rigs: every pixel comes from the camera that looks there."""

from dataclasses import replace

import numpy as np
import pytest
from cameras import directions, shot, turned

from p2gs_jax.paths.panorama import Cylinder, covering, render_wide, slices, stitch

YAWS = (-45, 0, 45)
WALL = 6.0


def colour(d):
    """Return a smooth colour for every direction."""
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    waves = np.sin(5 * d @ np.array([[1.0, 0.3, 0], [0.2, 1, 0.5], [0, 0.4, 1]]))
    return (0.5 + 0.4 * waves).astype(np.float32)


def cameras(**more):
    return [shot(turned(y, **more), f"{y}", width=96) for y in YAWS]


def test_every_pixel_comes_from_the_camera_that_looks_there():
    shots = cameras()
    cylinder = covering(shots, turned())
    flat = [np.full((s.height, s.width, 1), k + 1, np.float32) for k, s in enumerate(shots)]
    source = stitch(flat, shots, cylinder)[..., 0]
    assert set(np.unique(source)) == {1, 2, 3}  # hard edges: nothing between
    edges = np.flatnonzero(np.diff(source[cylinder.height // 2])) + 1
    edges = cylinder.left + edges / cylinder.focal
    np.testing.assert_allclose(np.rad2deg(edges), [-22.5, 22.5], atol=0.7)
    assert (stitch(flat[:1], shots[:1], cylinder)[:, -1] == 0).all()


def test_the_cylinder_covers_only_directions_that_cameras_see():
    cylinder = covering(cameras(), turned())
    half = cylinder.span / 2
    assert np.rad2deg(half) == pytest.approx(75, abs=1.2)
    assert cylinder.left == pytest.approx(-half, abs=0.02)
    focal = cameras()[0].K[0, 0]
    assert cylinder.focal == focal
    # The edge of an image is nearest to the horizon at its corners, 30 degrees off the axis.
    assert -cylinder.top == pytest.approx(24 / focal * np.cos(np.pi / 6), abs=0.02)
    small = cylinder.resized(cylinder.width // 2)
    assert small.span == pytest.approx(cylinder.span)
    assert small.height == pytest.approx(cylinder.height / 2, abs=0.5)
    ring = [shot(turned(y)) for y in range(0, 360, 45)]
    assert covering(ring, turned()).span == pytest.approx(2 * np.pi, abs=0.02), "once around"


@pytest.mark.parametrize(
    ("yaws", "span", "gapless"), [((150, 210), 120, True), ((-60, 60), 180, False)]
)
def test_neighbours_share_a_cylinder_and_gaps_between_cameras_stay_empty(yaws, span, gapless):
    shots = [shot(turned(y)) for y in yaws]
    cylinder = covering(shots, turned())
    assert np.rad2deg(cylinder.span) == pytest.approx(span, abs=3)
    flat = [np.full((s.height, s.width, 1), k + 1, np.float32) for k, s in enumerate(shots)]
    source = stitch(flat, shots, cylinder)[..., 0]
    assert (source > 0).all() == gapless
    assert (source[:, cylinder.width // 2] > 0).all() == gapless
    assert set(source[cylinder.height // 2].tolist()) - {0} == {1, 2}


def test_a_wide_view_rendered_in_slices_shows_the_cylinder():
    cylinder = Cylinder(turned(20, (1, 2, 3), pitch=5), 120.0, np.deg2rad(-70), -0.5, 290, 100)
    covered = replace(cylinder, viewmat=turned())

    def render(s):
        # The opacity is 0.8; it weights radiance and depth, as in the renderer.
        d = directions(s)
        local = d @ s.viewmat[:3, :3].T
        level = d @ cylinder.viewmat[:3, :3].T
        z = WALL / np.hypot(level[..., 0], level[..., 2]) * local[..., 2]
        return 0.8 * colour(d), np.full(d.shape[:2], 0.8, np.float32), 0.8 * z

    linear, alpha = render_wide(render, cylinder)
    np.testing.assert_allclose(linear, 0.8 * colour(cylinder.rays()), atol=0.004)
    np.testing.assert_allclose(alpha, 0.8, rtol=1e-6)
    assert len({(s.width, s.height) for s in slices(covered)}) == 1
