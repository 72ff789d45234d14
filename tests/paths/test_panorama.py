from dataclasses import replace

import numpy as np
import pytest
from cameras import directions, shot, turned

from p2gs_jax.paths.panorama import Cylinder, covering, render_wide, slices, stitch
from p2gs_jax.paths.pictures import comparison_size, titled

YAWS = (-45, 0, 45)
WALL = 6.0


def colour(d):
    """Return a smooth colour for every direction."""
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    waves = np.sin(5 * d @ np.array([[1.0, 0.3, 0], [0.2, 1, 0.5], [0, 0.4, 1]]))
    return (0.5 + 0.4 * waves).astype(np.float32)


def wall_point(center, d):
    """Return where rays from a point meet a wall of radius WALL about the world's y axis."""
    a = d[..., 0] ** 2 + d[..., 2] ** 2
    b = center[0] * d[..., 0] + center[2] * d[..., 2]
    c = center[0] ** 2 + center[2] ** 2 - WALL**2
    return center + ((-b + np.sqrt(b**2 - a * c)) / a)[..., None] * d


def cameras(**more):
    return [shot(turned(y, **more), f"{y}", width=96) for y in YAWS]


def test_every_pixel_comes_from_the_camera_that_looks_there_but_for_masked_ones():
    shots = cameras()
    cylinder = covering(shots, turned())
    flat = [np.full((s.height, s.width, 1), k, np.float32) for k, s in enumerate(shots)]
    image, source = stitch(flat, shots, cylinder)
    np.testing.assert_array_equal(image[..., 0], source)  # hard edges: nothing between
    edges = np.flatnonzero(np.diff(source[cylinder.height // 2])) + 1
    edges = cylinder.left + edges / cylinder.focal
    np.testing.assert_allclose(np.rad2deg(edges), [-22.5, 22.5], atol=0.7)
    # A masked camera gives way, and unseen pixels are marked.
    images = [colour(directions(s)) for s in shots]
    masks = [np.ones((s.height, s.width), np.float32) for s in shots]
    masks[1][:] = 0
    _, source = stitch(images, shots, cylinder, masks=masks)
    assert set(np.unique(source)) == {-1, 0, 2}
    image, source = stitch(images[:1], shots[:1], cylinder)
    assert (image[source < 0] == 0).all()
    assert (source[:, -1] == -1).all()
    with pytest.raises(ValueError, match="image 0"):
        stitch([np.zeros((4, 4, 3), np.float32)], shots[:1], cylinder)


def test_depth_takes_the_parallax_of_displaced_cameras_away():
    shots = [
        shot(turned(y, center), f"{y}", width=96)
        for y, center in zip(YAWS, [(-0.5, 0, 0.2), (0, 0.1, 0.4), (0.5, 0, 0.2)], strict=True)
    ]
    centers = [-s.viewmat[:3, :3].T @ s.viewmat[:3, 3] for s in shots]
    images = [colour(wall_point(c, directions(s))) for c, s in zip(centers, shots, strict=True)]
    cylinder = covering(shots, turned())
    near = np.full((cylinder.height, cylinder.width), 1 / WALL)
    image, source = stitch(images, shots, cylinder, near)
    truth = colour(wall_point(np.zeros(3), cylinder.rays()))
    there = source >= 0
    assert there.mean() > 0.9
    assert np.abs(image - truth)[there].max() < 0.01
    far, _ = stitch(images, shots, cylinder)
    assert np.abs(far - truth)[there].max() > 0.05


def test_the_cylinder_is_cut_to_what_the_cameras_see():
    cylinder = covering(cameras(), turned())
    half = cylinder.span / 2
    assert np.rad2deg(half) == pytest.approx(75, abs=1.2)
    assert cylinder.left == pytest.approx(-half, abs=0.02)
    focal = cameras()[0].K[0, 0]
    assert cylinder.focal == focal
    # The lowest edge of an image is nearest to the horizon in its corners, 30 degrees off the axis.
    assert -cylinder.top == pytest.approx(24 / focal * np.cos(np.pi / 6), abs=0.02)
    small = cylinder.resized(cylinder.width // 2)
    assert small.span == pytest.approx(cylinder.span)
    assert small.height == pytest.approx(cylinder.height / 2, abs=0.5)
    ring = [shot(turned(y)) for y in range(0, 360, 45)]
    assert covering(ring, turned()).span == pytest.approx(2 * np.pi, abs=0.02), "once around"


@pytest.mark.parametrize(
    ("yaws", "span", "seen"), [((150, 210), 120, True), ((-60, 60), 180, False)]
)
def test_cameras_stay_together_and_a_gap_stays_between_them(yaws, span, seen):
    shots = [shot(turned(y)) for y in yaws]
    cylinder = covering(shots, turned())
    assert np.rad2deg(cylinder.span) == pytest.approx(span, abs=3)
    _, source = stitch([np.ones((s.height, s.width, 1)) for s in shots], shots, cylinder)
    assert (source >= 0).all() == seen
    assert (source[:, cylinder.width // 2] >= 0).all() == seen
    assert set(source[cylinder.height // 2].tolist()) - {-1} == {0, 1}


def test_a_wide_view_of_slices_is_the_cylinder_itself():
    cylinder = Cylinder(turned(20, (1, 2, 3), pitch=5), 120.0, np.deg2rad(-70), -0.5, 290, 100)
    covered = replace(cylinder, viewmat=turned())

    def render(s):
        # Half transparent: linear and depth are weighted, as the renderer's.
        d = directions(s)
        local = d @ s.viewmat[:3, :3].T
        level = d @ cylinder.viewmat[:3, :3].T
        z = WALL / np.hypot(level[..., 0], level[..., 2]) * local[..., 2]
        return 0.8 * colour(d), np.full(d.shape[:2], 0.8, np.float32), 0.8 * z

    wide = render_wide(render, cylinder)
    np.testing.assert_allclose(wide.linear, 0.8 * colour(cylinder.rays()), atol=0.004)
    np.testing.assert_allclose(wide.alpha, 0.8, rtol=1e-6)
    np.testing.assert_allclose(wide.nearness, 1 / WALL, rtol=1e-3)
    assert len({(s.width, s.height) for s in slices(covered)}) == 1

    def blank(s):
        nothing = np.zeros((s.height, s.width), np.float32)
        return nothing[..., None].repeat(3, -1), nothing, nothing

    assert (render_wide(blank, cylinder).nearness == 0).all(), "what is transparent is far"


def test_images_come_through_between_lines_of_text():
    rng = np.random.default_rng(0)
    images = [np.rint(255 * rng.uniform(size=(20 + k, 300, 3))) / 255 for k in range(3)]
    sheet = titled([("one", images[0]), ("", images[1]), ("three", images[2])])
    line = (sheet.shape[0] - 63) // 3
    for image, top in zip(images, (line, 20 + 2 * line, 41 + 3 * line), strict=True):
        np.testing.assert_allclose(sheet[top : top + len(image)], image, atol=1e-6)
    assert sheet[:line].min() < 0.5, "the title is there"
    assert (sheet[20 + line : 20 + 2 * line] == 1).all(), "no title, no ink"
    cylinder = Cylinder(turned(), 50.0, 0.0, 0.0, 300, 21)
    assert sheet.shape[1::-1] == comparison_size(cylinder)
