"""Points projected into views: positions, occlusion, and exposures without tracks."""

import csv
import dataclasses

import numpy as np
import pytest

from p2gs_jax.config import preset
from p2gs_jax.evaluate.alignment import exposure_error
from p2gs_jax.init.correspondence import (
    MOST_PER_POINT,
    project_points,
    projected_colors,
    unoccluded,
)
from p2gs_jax.prepare import calibrate_observations
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.synth.write import write_street


def test_a_wall_hides_what_is_behind_it():
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


def test_behind_and_outside_are_invisible():
    xy = np.array([[5.0, 5.0], [5.0, 5.0], [-1.0, 5.0], [5.0, 11.0]])
    z = np.array([2.0, -2.0, 2.0, 2.0])
    assert unoccluded(xy, z, 10, 10).tolist() == [True, False, False, False]
    assert not unoccluded(xy[1:2], z[1:2], 10, 10).any()


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    root = tmp_path_factory.mktemp("street") / "scene"
    write_street(root, frames=5, width=192, height=128, points=6000, iso_std=4.0, seed=3)
    return root


def test_positions_are_those_of_the_tracks(street, tmp_path):
    cfg = preset("robust")
    scene = load_scene(street, cfg.data, tmp_path, lambda text: None)
    tracks = scene.tracks
    mine = tracks.view_indices == 3
    xy, z = project_points(scene.points[tracks.point_indices[mine]], scene.views[3])
    assert np.all(z > 0)
    assert np.median(np.abs(xy - tracks.xy[mine])) < 0.5


def test_exposures_without_tracks(street, tmp_path):
    cfg = preset("robust")
    scene = load_scene(street, cfg.data, tmp_path, lambda text: None)
    scene = dataclasses.replace(scene, tracks=None)
    observations = projected_colors(scene, ImageStore(scene.views, cfg.data))
    assert np.bincount(observations.points).max() <= MOST_PER_POINT
    solved = calibrate_observations(observations, scene, cfg).solution
    with (street / "truth" / "exposures.csv").open(newline="") as file:
        truth = {r["image"]: float(r["exposure"]) for r in csv.DictReader(file)}
    expected = np.array([truth[scene.views[i].name] for i in scene.train_indices])
    assert exposure_error(np.exp(solved.log_exposures), expected)["ev"] < 0.03
