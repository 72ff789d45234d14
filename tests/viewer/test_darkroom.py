"""A frame is developed in many ways. Settings follow the run."""

from dataclasses import replace

import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import develop
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.pixels.store import camera_of
from p2gs_jax.viewer.live import Darkroom
from p2gs_jax.viewer.pictures import limits_of_depth
from p2gs_jax.viewer.settings import (
    Settings,
    common_settings,
    display_of,
    exposures_ev,
    settings_of_view,
)
from p2gs_jax.viewer.viewed_run import ViewedRun


@pytest.fixture(scope="module")
def viewed(finished_run):
    out = ViewedRun(load_run(finished_run), 1920)
    yield out
    out.renderer.stop()
    out.store.close()


@pytest.fixture(scope="module")
def run(viewed):
    return viewed.run


@pytest.fixture
def darkroom(viewed):
    return Darkroom(viewed)


@pytest.fixture(scope="module")
def frame(viewed):
    return viewed.renderer.render_now(camera_of(viewed.store, 1))


def moved(frame, axis, by):
    viewmat = frame.camera.viewmat.at[axis, 3].add(by)
    return replace(frame, camera=replace(frame.camera, viewmat=viewmat))


def test_a_view_looks_as_the_run_says(darkroom, frame, run):
    for index in (run.scene.train_indices[0], run.scene.test_indices[0]):
        settings = settings_of_view(run, index, common_settings(run))
        expected = develop(frame.linear, run.own_display(index))
        np.testing.assert_allclose(darkroom.develop(frame, settings), expected, atol=1e-5)


def test_exposures_count_from_the_mean_whatever_the_gauge(run):
    old = run.params.photometry
    shifted = replace(old, raw_exposures=old.raw_exposures + 1.3)
    other = replace(run, params=replace(run.params, photometry=shifted))
    index = run.scene.train_indices[1]
    settings = settings_of_view(other, index, common_settings(other))
    np.testing.assert_allclose(
        display_of(other, settings).exposure, other.own_display(index).exposure, rtol=1e-5
    )
    np.testing.assert_allclose(settings.exposure_ev, exposures_ev(run)[index], atol=1e-5)


def test_looks_keep_what_does_not_belong_to_them(run):
    before = Settings(gamma=3.0, exposure_ev=2.0, curve="linear", mode="stops", split=0.2)
    common = common_settings(run, before)
    assert (common.mode, common.split, common.curve) == ("stops", 0.2, "run")
    assert common.exposure_ev == 0
    view = settings_of_view(run, 1, before)
    assert (view.mode, view.split, view.taken_as) == ("stops", 0.2, 1)
    np.testing.assert_allclose(view.exposure_ev, exposures_ev(run)[1], atol=1e-5)


def test_corrections_hold_under_the_curve_they_were_learned_with(run):
    views = len(run.scene.train_indices)
    corrections = np.random.default_rng(0).normal(size=(views, 3, 4)).astype(np.float32)
    photometry = replace(run.cfg.photometry, appearance="affine")
    with_corrections = replace(
        run,
        params=replace(run.params, appearance=corrections),
        cfg=replace(run.cfg, photometry=photometry),
    )
    index = run.scene.train_indices[2]
    own = settings_of_view(with_corrections, index, Settings(gamma=2.2))
    np.testing.assert_array_equal(display_of(with_corrections, own).correction, corrections[2])
    mean = display_of(with_corrections, replace(own, taken_as=None))
    np.testing.assert_allclose(mean.correction, corrections.mean(0), atol=1e-6)
    other = replace(own, curve="linear")
    assert display_of(with_corrections, other).correction is None


def test_photographs_are_found_where_they_were_taken(viewed, frame):
    assert viewed.view_at(frame.camera) == 1
    away = moved(frame, 0, 0.05)
    assert viewed.view_at(away.camera) is None
    assert viewed.nearest_view(away.camera) == 1


def test_the_split_shows_the_photograph_in_its_place(darkroom, viewed, frame, run):
    settings = settings_of_view(run, 1, Settings(gamma=2.2, mode="split", split=0.5))
    shown, photo = darkroom.develop(frame, settings), viewed.store.get(1)[0]
    width = photo.shape[1]
    left, right = np.s_[2:-2, 2 : width // 2 - 3], np.s_[:, width // 2 + 3 :]
    np.testing.assert_allclose(shown[left], photo[left], atol=2e-3)
    rendered = darkroom.develop(frame, replace(settings, mode="display"))
    np.testing.assert_array_equal(shown[right], rendered[right])
    # ... and it is about the same thing, so the halves belong together.
    assert np.mean(np.abs(rendered[left] - photo[left])) < 0.15


def test_a_broken_photograph_is_said_until_one_can_be_shown(
    darkroom, viewed, frame, run, monkeypatch
):
    def broken(*args):
        raise UserError("0.png is torn.", fix="mend it")

    split = replace(common_settings(run), mode="split")
    with monkeypatch.context() as patch:
        patch.setattr(viewed.store, "get", broken)
        darkroom.develop(frame, split)
        assert "0.png is torn." in darkroom.legend(frame, split)
    darkroom.develop(frame, split)
    assert darkroom.legend(frame, split) is None


def test_where_no_photograph_was_taken_the_split_is_the_picture(darkroom, frame):
    away, settings = moved(frame, 2, 0.4), Settings(gamma=2.2, mode="split")
    assert "No photograph" in darkroom.legend(away, settings)
    np.testing.assert_array_equal(
        darkroom.develop(away, settings),
        darkroom.develop(away, replace(settings, mode="display")),
    )


def test_depth_colours_stay_until_they_are_set_anew(darkroom, frame):
    settings = Settings(gamma=2.2, mode="depth")
    darkroom.develop(frame, settings)
    limits = darkroom.depth_limits
    assert limits == limits_of_depth(frame)
    darkroom.develop(replace(frame, depth=2 * frame.depth), settings)
    assert darkroom.depth_limits == limits
    assert "depth, scene units" in darkroom.legend(frame, settings)


def test_a_metered_exposure_follows_the_picture(darkroom, viewed, frame, run):
    settings = replace(common_settings(run), metered=True)
    here = darkroom.transform(frame, settings).exposure
    assert here == pytest.approx(run.metered_display(run.render(frame.camera)).exposure, rel=1e-4)
    more = darkroom.transform(frame, replace(settings, exposure_ev=1.0)).exposure
    assert more == pytest.approx(2 * here)
    plain = darkroom.transform(frame, replace(settings, metered=False)).exposure
    assert plain == pytest.approx(run.mean.exposure_geometric, rel=1e-5)
    other = viewed.renderer.render_now(camera_of(viewed.store, 2))
    there = run.metered_display(run.render(other.camera)).exposure
    adapting = darkroom.transform(other, settings, settled=False).exposure
    assert min(here, there) <= adapting <= max(here, there)
    assert darkroom.transform(other, settings).exposure == pytest.approx(there, rel=1e-4)
    assert darkroom.metered_exposure == pytest.approx(there, rel=1e-4)
