"""Points projected into views: occlusion, samples, and exposures without tracks."""

import csv
import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scene.helpers import make_view

from p2gs_jax import exposure_error, load_scene, preset
from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.photometry.calibrate import calibrate_observations, options_of
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.sources.points import MOST_PER_POINT, projected_colors, track_colors
from p2gs_jax.photometry.sources.sampling import has_black_border, sample, unclipped_from
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.visibility import unoccluded
from p2gs_jax.types import Scene, Tracks


def test_a_wall_hides_points_behind_it():
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform(20, 60, (600, 2)), np.full((600, 1), 5.0)], 1)
    far = np.concatenate([rng.uniform(0, 100, (800, 2)), np.full((800, 1), 20.0)], 1)
    every = np.concatenate([wall, far])
    visible = unoccluded(every[:, :2], every[:, 2], 100, 100)
    assert visible[:600].all()
    inner = np.all((far[:, :2] > 25) & (far[:, :2] < 55), 1)
    outer = np.any((far[:, :2] < 10) | (far[:, :2] > 70), 1)
    assert visible[600:][inner].mean() < 0.02
    assert visible[600:][outer].mean() > 0.98
    # Points behind the camera or outside the image are not visible.
    xy = np.array([[5.0, 5.0], [5.0, 5.0], [-1.0, 5.0], [5.0, 11.0]])
    z = np.array([2.0, -2.0, 2.0, 2.0])
    assert unoccluded(xy, z, 10, 10).tolist() == [True, False, False, False]
    assert not unoccluded(xy[1:2], z[1:2], 10, 10).any()


CFG, CHOICE = preset("robust"), (Form("view_exposure"), Response())


def test_exposures_need_no_tracks_and_left_out_points_are_counted(noisy_street, tmp_path):
    scene = load_scene(noisy_street, CFG.data, tmp_path, lambda text: None)
    views, index = list(scene.views), scene.train_indices[1]
    half = np.tile(np.uint8(255), (views[index].height, views[index].width))
    half[: len(half) // 2] = 0
    assert cv2.imwrite(str(tmp_path / "half.png"), half)
    views[index] = dataclasses.replace(views[index], mask_path=tmp_path / "half.png")
    scene = dataclasses.replace(scene, tracks=None, views=tuple(views))
    observations = projected_colors(scene, ImageStore(scene.views, CFG.data))
    assert observations.black_borders is not None
    assert not observations.black_borders.any()
    bordered = np.arange(observations.view_count) == 1
    np.testing.assert_array_equal(observations.kept_by_mask, np.where(bordered, 0.5, np.nan))
    faults = {"black_borders": bordered, "kept_by_mask": np.where(bordered, 0.03, np.nan)}
    observations = dataclasses.replace(observations, too_coarse=7, **faults)
    assert np.bincount(observations.points).max() <= MOST_PER_POINT
    options = dataclasses.replace(options_of(CFG, scene), choice=CHOICE)
    found = calibrate_observations(observations, options)
    assert found.reasons[0].startswith("7 of ")
    note = f"The edges of 1 training view are black ({observations.names[1]}), as"
    assert found.reasons[1].startswith(note)
    assert found.reasons[2].startswith("Masks keep only 3% of the pixels")
    faults["kept_by_mask"] = np.where(bordered, 1.0, np.nan)
    found = calibrate_observations(dataclasses.replace(observations, **faults), options)
    assert found.reasons[2].startswith("Masks of 1 training view hide nothing.")
    with (noisy_street / "truth" / "exposures.csv").open(newline="") as file:
        truth = {r["image"]: float(r["exposure"]) for r in csv.DictReader(file)}
    expected = np.array([truth[scene.views[i].name] for i in scene.train_indices])
    assert exposure_error(np.exp(found.solution.log_exposures), expected)["ev"] < 0.03


class Grey(ImageStore):
    """Photographs of one grey."""

    def __init__(self):
        pass

    def whole(self, index):
        return np.full((40, 60, 3), 0.5, np.float32), np.ones((40, 60), np.float32)


def seen_from(distances, points=1):
    """Return a scene with a view at every distance of a place; a negative one is behind it."""
    views = [
        make_view(Path(f"{k}.png"), f=50.0, at=(0, 0, -distance), size=(60, 40))
        for k, distance in enumerate(distances)
    ]
    count = len(distances) * points
    of_view, of_point = np.divmod(np.arange(count), points)
    tracks = Tracks(of_view, of_point, np.full((count, 2), 20.0, np.float32))
    where = np.zeros((points, 3), np.float32)
    where[:, :2] = 1e-3 * np.stack(np.divmod(np.arange(points), 8), 1)
    return Scene(Path("."), "made", tuple(views), where, np.zeros((points, 3), np.uint8), tracks)


@pytest.mark.parametrize(
    ("distances", "kept", "left_out"),
    [
        ([2.0, 5.9, 6.1, 30.0], [0, 1], 2),  # too far away
        ([-1.0, 3.0, 5.0], [1, 2], 1),  # a track behind its camera is not the closest
        ([-1.0, -3.0], [], 2),  # behind all of its cameras
    ],
)
def test_observations_from_too_far_away_are_left_out_and_counted(distances, kept, left_out):
    found = track_colors(seen_from(distances), Grey())
    assert found.views.tolist() == kept
    assert found.too_coarse == left_out


def test_coarse_views_are_kept_if_nothing_else_ties_them():
    """Photographs of two resolutions would share no point, and their exposures be unknown."""
    found = track_colors(seen_from([2.0, 2.1, 10.0, 10.5, 40.0], points=32), Grey())
    assert np.bincount(found.views).tolist() == [32] * 4
    assert found.too_coarse == 32


def test_black_borders_are_told_from_dark_photographs():
    lit, night = np.full((2, 40, 60, 3), 0.3, np.float32)
    mask = np.ones((40, 60), np.float32)
    lit[:, :3], night[:] = 1 / 255, 1 / 255
    assert has_black_border(lit, mask)
    mask[:, :3] = 0
    assert not has_black_border(lit, mask)
    assert not has_black_border(night, np.ones((40, 60), np.float32))


def test_exposures_are_right_where_a_surface_has_highlights():
    """Means of patches with clipped pixels are too dark: as if the exposure were shorter."""
    rng = np.random.default_rng(0)
    radiance = 0.05 * np.exp(0.2 * rng.standard_normal((120, 120, 1)))
    radiance[rng.uniform(size=radiance.shape) < 0.01] = 0.8
    xy = rng.uniform(5, 115, (3000, 2))
    mask, gains = np.ones((120, 120), np.float32), (1.0, 4.0)
    shown = [srgb_encode(np.minimum(g * radiance, 1)).astype(np.float32) for g in gains]
    seen = [sample(np.repeat(grey, 3, 2), mask, xy) for grey in shown]
    parts = (np.concatenate([getattr(s, n) for s in seen]) for n in ("colors", "spread"))
    rows = (np.repeat([0, 1], 3000), np.tile(np.arange(3000), 2))
    brightest = np.concatenate([s.brightest for s in seen])
    observations = Observations(*rows, *parts, 2, 3000, np.zeros(2, int), brightest=brightest)
    for kept, right in (
        (observations, True),
        (dataclasses.replace(observations, brightest=None), False),
    ):
        usable = kept.usable(4 / 255, 250 / 255)[:, 0].reshape(2, 3000).all(0)
        light = srgb_decode(kept.colors[:, 0]).reshape(2, 3000)[:, usable]
        ratio = np.mean(np.log2(light[1] / light[0]))
        assert (abs(ratio - 2) < 1e-3) == right
        assert usable.mean() > 0.5
    few = observations.picked(np.arange(7))
    np.testing.assert_array_equal(few.brightest, observations.brightest[:7])


def test_exposures_are_right_where_noise_is_clipped_at_black():
    """Noise below black becomes black, so that means of dark pixels are too bright."""
    rng = np.random.default_rng(0)
    radiance = np.kron(0.2 * np.exp(rng.standard_normal((40, 40))), np.ones((6, 6)))[..., None]
    xy = 6 * (np.argwhere(np.ones((40, 40)))[:, ::-1] + 0.5)
    mask, gains = np.ones((240, 240), np.float32), np.array([1.0, 1 / 16, 1 / 32, 1 / 64])
    shown = []
    for light in (g * np.repeat(radiance, 3, 2) for g in gains):
        noise = 3 * np.sqrt(2e-4 * light + 1e-6) * rng.standard_normal(light.shape)
        shown.append(np.float32(np.rint(255 * srgb_encode(light + noise)) / 255))
    seen, count = [sample(photo, mask, xy) for photo in shown], len(xy)
    parts = (np.concatenate([getattr(s, n) for s in seen]) for n in ("colors", "spread"))
    rows = (np.repeat(np.arange(4), count), np.tile(np.arange(count), 4))
    unclipped = np.array([unclipped_from(photo, mask) for photo in shown])
    # Twice the noise is 26 of 255. Hardly any block of the last one is so bright.
    assert np.all((255 * unclipped[1:3] > 26) & (255 * unclipped[1:3] < 40))
    assert np.all(unclipped[[0, 3]] == [[0.0], [1.0]])
    assert not unclipped_from(np.repeat(srgb_encode(radiance), 3, 2), mask).any()
    observations = Observations(*rows, *parts, 4, count, np.zeros(4, int), unclipped=unclipped)
    options = dataclasses.replace(options_of(CFG, seen_from([1.0, 2.0])), choice=CHOICE)
    for kept, least, most in (
        (observations, 0.0, 0.01),
        (dataclasses.replace(observations, unclipped=None), 0.02, np.inf),
    ):
        found = calibrate_observations(kept, options).solution.log_exposures
        assert least <= exposure_error(np.exp(found), gains)["ev"] < most


def test_samples_sit_at_pixel_centres():
    rng = np.random.default_rng(0)
    # A ramp of light: patches are averaged linearly.
    ramp = srgb_encode(np.linspace(0.2, 1, 50))[None, :, None]
    image = np.tile(ramp, (40, 1, 3)).astype(np.float32)
    xy = rng.uniform(9, 31, (100, 2))
    light = 0.2 + 0.8 * (xy[:, 0] - 0.5) / 49
    # `spread` is the change over half a pixel, on a ramp of 0.8/49 per pixel.
    slope = (srgb_encode(light + 1e-4) - srgb_encode(light - 1e-4)) / 2e-4
    colors, spread, _, contrast, valid = sample(image, np.ones((40, 50), np.float32), xy)
    assert valid.all()
    np.testing.assert_allclose(colors[:, 0], srgb_encode(light), atol=2e-4)
    np.testing.assert_allclose(spread[:, 0], 0.5 * slope * 0.8 / 49, rtol=5e-3)
    # Three samples lie one pixel apart.
    np.testing.assert_allclose(contrast[:, 0], (2 / 3) ** 0.5 * 0.8 / 49 / light, rtol=5e-3)


def test_samples_outside_and_masked_and_at_the_border_are_invalid():
    image, ones = np.zeros((40, 50, 3), np.float32), np.ones((40, 50), np.float32)
    xy = np.array([[0.5, 10.0], [3.5, 10.0]])
    assert sample(image, ones, xy).valid.tolist() == [False, True]
    mask = np.ones((40, 50), np.float32)
    mask[:20] = 0
    xy = np.array([[-3.0, 30], [25, 10], [25, 30], [60, 30], [25, 20.4]])
    assert sample(image, mask, xy).valid.tolist() == [False, False, True, False, False]
