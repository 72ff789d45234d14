"""A frame is rendered once; looks change it afterwards. Settings follow the run."""

from dataclasses import replace

import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import develop
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.viewer.frame_cache import FrameCache
from p2gs_jax.viewer.settings import (
    Settings,
    common_settings,
    display_of,
    exposures_ev,
    settings_of_view,
)


class Counting:
    """The renderer, counting."""

    def __init__(self, run):
        self.count, self.run, self.renderer = 0, run, make_renderer(run.cfg.render)

    def render(self, camera):
        self.count += 1
        return self.renderer(self.run.params.gaussians, self.run.alive, camera)


@pytest.fixture(scope="module")
def run(finished_run):
    return load_run(finished_run)


@pytest.fixture
def setup(run):
    store = ImageStore(run.scene.views, run.cfg.data)
    programs = Counting(run)
    out = FrameCache(run, store, programs, typical=4.0)
    assert out.render(camera_of(store, 1))
    yield out, programs, store
    store.close()


def test_a_new_look_renders_nothing(setup, run):
    frame_cache, programs, _ = setup
    start = common_settings(run)
    shown = [
        frame_cache.develop(replace(start, **change))
        for change in (
            {},
            {"exposure_ev": 1.5},
            {"gamma": 1.5},
            {"curve": "linear"},
            {"mode": "stops"},
            {"mode": "clipping", "exposure_ev": 3.0},
            {"mode": "depth"},
            {"mode": "split"},
        )
    ]
    assert programs.count == 1
    assert all(np.any(a != b) for i, a in enumerate(shown) for b in shown[:i])


def test_one_stop_doubles_the_light(setup, run):
    frame_cache, _, _ = setup
    start = Settings(gamma=2.2, curve="linear")
    dark, light = (frame_cache.develop(replace(start, exposure_ev=ev)) for ev in (-3.0, -2.0))
    inside = (light < 1) & (dark > 1e-5)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(light[inside], 2 * dark[inside], rtol=1e-4)


def test_a_view_looks_as_the_run_says(setup, run):
    frame_cache, _, _ = setup
    for index in (run.scene.train_indices[0], run.scene.test_indices[0]):
        settings = settings_of_view(run, index, common_settings(run))
        expected = develop(frame_cache.frame.linear, run.own_display(index))
        np.testing.assert_allclose(frame_cache.develop(settings), expected, atol=1e-5)


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


def test_photographs_are_found_where_they_were_taken(setup, run):
    frame_cache, _, store = setup
    here = camera_of(store, 3)
    assert frame_cache.view_at(here) == 3
    moved = replace(here, viewmat=here.viewmat.at[0, 3].add(0.05))
    assert frame_cache.view_at(moved) is None
    assert frame_cache.nearest_view(moved) == 3


def test_the_split_shows_the_photograph_in_its_place(setup, run):
    frame_cache, _, store = setup
    settings = settings_of_view(run, 1, Settings(gamma=2.2, mode="split", split=0.5))
    shown = frame_cache.develop(settings)
    photo = store.get(1)[0]
    width = photo.shape[1]
    left = np.s_[2:-2, 2 : width // 2 - 3]
    np.testing.assert_allclose(shown[left], photo[left], atol=2e-3)
    right = np.s_[:, width // 2 + 3 :]
    rendered = frame_cache.develop(replace(settings, mode="display"))
    np.testing.assert_array_equal(shown[right], rendered[right])
    # ... and it is about the same thing, so the halves belong together.
    assert np.mean(np.abs(rendered[left] - photo[left])) < 0.15


def test_a_broken_photograph_is_said_until_one_can_be_shown(setup, run, monkeypatch):
    frame_cache, _, store = setup

    def broken(*args):
        raise UserError("0.png is torn.", fix="mend it")

    split = replace(common_settings(run), mode="split")
    with monkeypatch.context() as patch:
        patch.setattr(store, "get", broken)
        frame_cache.develop(split)
        assert frame_cache.photograph_error == "0.png is torn."
    frame_cache.develop(split)
    assert frame_cache.photograph_error is None


def test_where_no_photograph_was_taken_the_split_is_the_picture(setup, run):
    frame_cache, _, store = setup
    here = camera_of(store, 1)
    frame_cache.render(replace(here, viewmat=here.viewmat.at[2, 3].add(0.4)))
    settings = Settings(gamma=2.2, mode="split")
    assert not frame_cache.photographed_from_here
    np.testing.assert_array_equal(
        frame_cache.develop(settings), frame_cache.develop(replace(settings, mode="display"))
    )


def test_depth_colours_stay_until_they_are_set_anew(setup):
    frame_cache, _, store = setup
    settings = Settings(gamma=2.2, mode="depth")
    frame_cache.develop(settings)
    limits = frame_cache.depth_limits
    here = camera_of(store, 1)
    frame_cache.render(replace(here, viewmat=here.viewmat.at[2, 3].add(2.0)))
    frame_cache.develop(settings)
    assert frame_cache.depth_limits == limits
    frame_cache.set_depth_limits()
    assert frame_cache.depth_limits != limits


def test_a_metered_exposure_follows_the_picture(setup, run):
    frame_cache, _, store = setup
    settings = replace(common_settings(run), metered=True)
    here = frame_cache.transform(settings).exposure
    rendered = run.render(frame_cache.frame.camera)
    assert here == pytest.approx(run.metered_display(rendered).exposure, rel=1e-4)
    more = frame_cache.transform(replace(settings, exposure_ev=1.0)).exposure
    assert more == pytest.approx(2 * here)
    plain = frame_cache.transform(replace(settings, metered=False)).exposure
    assert plain == pytest.approx(run.mean.exposure_geometric, rel=1e-5)
    frame_cache.render(camera_of(store, 2))
    there = run.metered_display(run.render(camera_of(store, 2))).exposure
    adapting = frame_cache.transform(settings, settled=False).exposure
    assert min(here, there) <= adapting <= max(here, there)
    assert frame_cache.transform(settings).exposure == pytest.approx(there, rel=1e-4)
