"""Scores of drives: their static and moving parts, depth against LiDAR, seams of photographs."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
import splats
from made_drive import FAR, SPEED, WALL, make_recording
from splats import random_splats, rendered

from p2gs_jax import DisplayTransform, develop, evaluate
from p2gs_jax.config import DataConfig, FitConfig, LossConfig, PhotometryConfig
from p2gs_jax.core.atomic import plain
from p2gs_jax.evaluation import drives, seams
from p2gs_jax.evaluation.scores import mean_of_parts, parts_of, region_scores
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import headings
from p2gs_jax.scene.split import assign_split
from p2gs_jax.types import Lidar, Params, Photometry, Scene, Tracks, View

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Return a drive between two walls; frames 0 and 4 are held out."""
    scene = assemble(make_recording(tmp_path_factory.mktemp("drive")), DataConfig(ego_mask=False))
    return dataclasses.replace(scene, views=assign_split(scene.views, 4))


def corridor(camera, origin):
    """Return depth and alpha of two walls up to 5 m, the road between them, and the sky."""
    height, width = camera.height, camera.width
    viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
    y, x = np.mgrid[:height, :width] + 0.5
    local = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    rays = local @ viewmat[:3, :3]
    center = -viewmat[:3, :3].T @ viewmat[:3, 3] + origin - FAR
    with np.errstate(divide="ignore"):
        to_wall = np.where(rays[..., 1] > 0, WALL - center[1], -WALL - center[1]) / rays[..., 1]
        to_road = np.where(rays[..., 2] < 0, -center[2] / rays[..., 2], np.inf)
    depth = np.minimum(to_wall, to_road)
    sky = (center[2] + depth * rays[..., 2] > 5) | (depth > 200)
    return np.where(sky, 0, depth).astype(np.float32), (~sky).astype(np.float32)


@pytest.fixture(scope="module")
def metrics(scene):
    """Return metrics of a fit that shows both walls in one grey."""

    def render(gaussians, alive, camera, *args):
        depth, alpha = corridor(camera, np.array(scene.origin))
        linear = 0.16 * np.ones((*depth.shape, 3), np.float32)
        return rendered(*map(jnp.asarray, (linear, alpha, depth)))

    zeros = jnp.zeros(len(scene.train_indices))
    params = Params(random_splats(0, degree=0), Photometry(zeros, zeros, "log"))
    cfg = FitConfig()
    store = ImageStore(scene.views, cfg.data)
    out = evaluate(params, scene, store, cfg, render=render)
    store.close()
    return plain(out.metrics)


def test_scores_of_parts_stand_beside_those_of_whole_views(scene, metrics):
    for part in (metrics["train"], metrics["test"]["exposure_fitted"], metrics["test"]["averaged"]):
        assert part["whole"]["psnr"] == pytest.approx(part["psnr"])
        assert set(part["static"]) == {"psnr", "ssim", "views"}
        rows = part["per_view"].values()
        moving = [row["moving"]["psnr"] for row in rows if "moving" in row]
        assert 0 < len(moving) < len(rows)
        assert part["moving"]["views"] == len(moving)
        assert part["moving"]["psnr"] == pytest.approx(np.mean(moving))
    seen = {name.split("/")[0] for name, row in metrics["train"]["per_view"].items()
            if "moving" in row}  # fmt: skip
    assert "left" in seen
    assert "right" not in seen


def test_depth_agrees_with_the_walls_and_not_with_moving_objects(metrics):
    for split in ("all", "held_out"):
        depth = metrics["depth"][split]
        assert depth["static"]["median_m"] < 0.1
        assert depth["static"]["within_10_percent"] > 0.9
        # The fit shows the wall behind the car.
        assert depth["moving"]["within_10_percent"] < 0.5
        assert depth["moving"]["median_m"] > 0.5
    assert metrics["depth"]["held_out"]["views"] < metrics["depth"]["all"]["views"]


def test_points_on_moving_boxes_move_with_them(scene):
    lidar = scene.lidar
    rows = np.flatnonzero((lidar.objects >= 0) & (np.abs(lidar.times - 0.2) < 1e-6))
    assert len(rows) > 20
    later = drives.at_time(lidar, scene.objects, rows, 0.25)
    np.testing.assert_allclose(later - lidar.points[rows], [[1.5 * SPEED * 0.05, 0, 0]] * len(rows),
                               atol=1e-4)  # fmt: skip
    still = np.flatnonzero(lidar.objects < 0)[:10]
    np.testing.assert_array_equal(drives.at_time(lidar, (), still, 9.0), lidar.points[still])


def test_depth_without_a_surface_has_an_infinite_error():
    points = np.array([[0, 0, 5.0], [0, 0.1, 5.0]], np.float32)
    lidar = Lidar(points, np.zeros(2), np.full(2, -1))
    K = np.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]], np.float32)
    view = View("a", None, "a", np.eye(4, dtype=np.float32), K, 16, 12, time=0.01)
    nothing = np.zeros((12, 16), np.float32)
    found = drives.depth_errors(lidar, (), view, nothing, nothing, nothing + 1)
    assert np.isinf(found.error).all()
    assert drives.summary([found])["static"]["missing"] == 1.0
    right = drives.depth_errors(lidar, (), view, nothing + 5.2, nothing + 1, nothing + 1)
    assert drives.summary([right])["static"]["median_m"] == pytest.approx(0.2, abs=1e-5)
    assert drives.summary([right])["static"]["median_relative"] == pytest.approx(0.04, abs=1e-5)
    later = dataclasses.replace(view, time=1.0)
    assert not len(drives.depth_errors(lidar, (), later, nothing, nothing, nothing + 1)[0])
    assert drives.summary([]) == {}
    assert not len(drives.depth_errors(lidar, (), view, nothing, nothing, nothing).error)


def test_parts_with_too_few_pixels_are_left_out():
    mask, moving = np.ones((20, 20), np.float32), np.zeros((20, 20), bool)
    assert set(parts_of(mask, moving)) == {"whole", "static"}
    moving[:, 10:] = True
    parts = parts_of(mask, moving)
    target = np.full((20, 20, 3), 0.5, np.float32)
    wrong = target.copy()
    wrong[:, 10:] += 0.1
    scores = region_scores(None, wrong, target, parts)
    assert scores["moving"]["psnr"] == pytest.approx(20, abs=0.01)
    assert scores["static"]["psnr"] > 100
    assert scores["moving"]["ssim"] < scores["static"]["ssim"]
    assert region_scores(None, wrong, target, {}) == {}
    mean = mean_of_parts([scores, {"whole": scores["whole"]}])
    assert mean["whole"]["views"] == 2
    assert mean["moving"]["views"] == 1


def test_a_car_that_stands_keeps_its_heading():
    there = np.array([[0.0, 0, 0]] * 5 + [[1.0, 0, 0], [2.0, 0, 0], [2.0, 1, 0.5], [2, 2, 1.0]])
    found = headings(there, UP, np.array([0.0, 1, 0]))
    np.testing.assert_allclose(found[:5], [[1, 0, 0]] * 5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    assert found[-1] @ [0, 1, 0] > 0.9
    still = headings(np.zeros((3, 3)), UP, np.array([0.0, 2, 0]))
    np.testing.assert_allclose(still, [[0, 1, 0]] * 3)


SIZE, FOCAL, DEPTH = 64, 60.0, 4.0
TONE = PhotometryConfig()
COMMON = DisplayTransform(1.0, 2.2, TONE)


camera = functools.partial(splats.camera, width=SIZE, height=SIZE, focal=FOCAL)


def radiance(x: float) -> np.ndarray:
    """Return radiance of a textured plane at z = DEPTH in a camera at (x, 0, 0)."""
    v, u = (np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2) / FOCAL * DEPTH
    texture = 0.12 + 0.05 * np.sin(3 * (u + x)) + 0.04 * np.cos(4 * v)
    return np.stack([texture, 0.8 * texture, 1.1 * texture], -1).astype(np.float32)


def photographed(x: float, exposure: float, gamma: float = 2.2, claimed: float | None = None):
    """Return a photograph from x, whose transform states the exposure `claimed`."""
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
    ids=["a stop", "a wrong exposure", "another gamma"],
)
def test_seams_vanish_when_both_photographs_are_developed_alike(second, before, left):
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


def test_halves_lie_on_the_side_of_their_camera_and_match_after_development():
    first, second = photographed(0.5, 0.8), photographed(-0.5, 1.6)
    ones = jnp.ones((SIZE, SIZE))

    def render(camera):
        return rendered(jnp.zeros((SIZE, SIZE, 3)), ones, DEPTH * ones)

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
def test_neighbours_have_the_same_time_or_share_most_points(names, seen, held_out, most, pairs):
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
