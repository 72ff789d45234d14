"""Scenes in millimetres and kilometres, and a long way from the origin."""

import dataclasses

import numpy as np
import pytest
from tiny_scene import make_scene

from p2gs_jax import FitConfig, Scene, UserError, load_scene, with_fields
from p2gs_jax.pipeline import survey
from p2gs_jax.run.decisions import Decisions


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    root = tmp_path_factory.mktemp("scale") / "scene"
    return load_scene(make_scene(root, views=4, points=60), FitConfig().data)


def scaled(scene, factor, offset=0.0):
    def placed(view):
        pose = view.viewmat.copy()
        pose[:3, 3] *= factor
        pose[:3, 3] -= pose[:3, :3] @ np.full(3, offset)
        return dataclasses.replace(view, viewmat=pose)

    points = scene.points * factor + offset
    return dataclasses.replace(scene, points=points, views=tuple(map(placed, scene.views)))


def nearest(scene):
    return survey.near_depth(survey.seen_depths(scene.points, scene.training_views))


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1.0, 1e3])
def test_the_near_plane_follows_scenes_that_it_would_cut(scene, factor):
    some = scaled(scene, factor)
    depth = nearest(some)
    assert depth == pytest.approx(factor * nearest(scene), rel=1e-3)
    assert 3 * factor < depth < 3.5 * factor
    cfg = FitConfig()
    near = survey.near_plane(depth, cfg)
    notes = survey.scale_notes(some, cfg, depth)
    if factor >= 1:
        assert near == cfg.render.near
        assert notes == []
        return
    assert near == pytest.approx(0.2 * depth, rel=0.1)
    assert len(notes) == 1
    assert f"{near:g} scene units instead of 0.05" in notes[0]
    decided = dataclasses.replace(Decisions.as_given(cfg), near=near)
    assert decided.resolve(cfg).render.near == near
    assert Decisions.from_dict(decided.to_dict()) == decided


def test_a_near_plane_that_cuts_nothing_stays(scene):
    cfg = with_fields(FitConfig(), {"render.near": 0.5})
    assert survey.near_plane(nearest(scene), cfg) == 0.5
    assert survey.near_plane(None, cfg) == 0.5
    assert Decisions.as_given(cfg).resolve(cfg).render.near == 0.5


def test_gradients_are_scaled_up_to_half_the_depth_of_near_points_or_as_the_options_say(scene):
    depth, off = nearest(scene), with_fields(FitConfig(), {"loss.near_depth": 0.0})
    decided = dataclasses.replace(
        Decisions.as_given(FitConfig()), **survey.decided_scale(depth, FitConfig())
    )
    assert decided.resolve(FitConfig()).loss.near_depth == pytest.approx(depth / 2, rel=0.05)
    assert survey.decided_scale(depth, off)["near_depth"] == 0
    assert survey.decided_scale(None, FitConfig())["near_depth"] is None


def test_a_weight_of_alpha_needs_photographs_with_alpha(scene):
    cfg = with_fields(FitConfig(), {"loss.alpha": 0.1})
    with pytest.raises(UserError, match=r"--loss\.alpha has no effect"):
        survey.survey(scene, cfg)


def test_points_that_no_view_shows_have_no_depth(scene):
    for points in (-scene.points, scene.points[:0]):
        depths = survey.seen_depths(points, scene.training_views)
        assert survey.near_depth(depths) is None
        assert survey.extent_of_rates(300.0, depths, FitConfig()) == 300.0


def test_a_scene_far_from_the_origin_is_reported_as_coarse(scene):
    depth = nearest(scene)
    for offset, coarse in ((0.0, False), (1e3, False), (1e5, True)):
        notes = survey.scale_notes(scaled(scene, 1.0, offset), FitConfig(), depth)
        assert bool(notes) == coarse
    assert "1e+05 scene units from the origin" in notes[0]
    assert "Subtract a common offset" in notes[0]


def test_learning_rates_do_not_grow_with_the_length_of_a_drive(scene):
    cfg, views, points = FitConfig(), scene.training_views, scene.points
    far = [np.array([60.0 * k, 0, 0]) for k in range(10)]
    drive = [
        dataclasses.replace(view, viewmat=_moved(view.viewmat, by)) for by in far for view in views
    ]
    street = np.concatenate([points + by for by in far]).astype(np.float32)
    narrow, wide = survey.seen_depths(points, views), survey.seen_depths(street, drive)
    short = survey.extent_of_rates(300.0, narrow, cfg)
    assert 3 < short < 6
    assert survey.extent_of_rates(300.0, wide, cfg) == pytest.approx(short, rel=0.2)
    assert survey.extent_of_rates(0.5, narrow, cfg) == 0.5
    cameras = with_fields(cfg, {"optimizer.extent": "cameras"})
    assert survey.extent_of_rates(300.0, wide, cameras) == 300.0


def _moved(viewmat, by):
    pose = viewmat.copy()
    pose[:3, 3] -= pose[:3, :3] @ by
    return pose
