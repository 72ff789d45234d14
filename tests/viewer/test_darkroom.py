"""A frame is rendered once; looks change it afterwards. Settings follow the run."""

from dataclasses import replace

import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import develop
from p2gs_jax.render.host import make_renderer
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.viewer.darkroom import Darkroom
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
def room(run):
    store = ImageStore(run.scene.views, run.cfg.data)
    programs = Counting(run)
    out = Darkroom(run, store, programs, typical=4.0)
    assert out.render(camera_of(store, 1))
    yield out, programs, store
    store.close()


def test_a_new_look_renders_nothing(room, run):
    darkroom, programs, _ = room
    start = common_settings(run)
    shown = [
        darkroom.develop(replace(start, **change))
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


def test_one_stop_doubles_the_light(room, run):
    darkroom, _, _ = room
    start = Settings(gamma=2.2, curve="linear")
    dark, light = (darkroom.develop(replace(start, exposure_ev=ev)) for ev in (-3.0, -2.0))
    inside = (light < 1) & (dark > 1e-5)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(light[inside], 2 * dark[inside], rtol=1e-4)


def test_a_view_looks_as_the_run_says(room, run):
    darkroom, _, _ = room
    for index in (run.scene.train_indices[0], run.scene.test_indices[0]):
        settings = settings_of_view(run, index, common_settings(run))
        expected = develop(darkroom.frame.linear, run.own_display(index))
        np.testing.assert_allclose(darkroom.develop(settings), expected, atol=1e-5)


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


def test_photographs_are_found_where_they_were_taken(room, run):
    darkroom, _, store = room
    here = camera_of(store, 3)
    assert darkroom.view_at(here) == 3
    moved = replace(here, viewmat=here.viewmat.at[0, 3].add(0.05))
    assert darkroom.view_at(moved) is None
    assert darkroom.nearest_view(moved) == 3


def test_the_split_shows_the_photograph_in_its_place(room, run):
    darkroom, _, store = room
    settings = settings_of_view(run, 1, Settings(gamma=2.2, mode="split", split=0.5))
    shown = darkroom.develop(settings)
    photo = store.get(1)[0]
    width = photo.shape[1]
    left = np.s_[2:-2, 2 : width // 2 - 3]
    np.testing.assert_allclose(shown[left], photo[left], atol=2e-3)
    right = np.s_[:, width // 2 + 3 :]
    rendered = darkroom.develop(replace(settings, mode="display"))
    np.testing.assert_array_equal(shown[right], rendered[right])
    # ... and it is about the same thing, so the halves belong together.
    assert np.mean(np.abs(rendered[left] - photo[left])) < 0.15


def test_a_broken_photograph_is_said_until_one_can_be_shown(room, run, monkeypatch):
    darkroom, _, store = room

    def broken(*args):
        raise UserError("0.png is torn.", fix="mend it")

    split = replace(common_settings(run), mode="split")
    with monkeypatch.context() as patch:
        patch.setattr(store, "get", broken)
        darkroom.develop(split)
        assert darkroom.trouble == "0.png is torn."
    darkroom.develop(split)
    assert darkroom.trouble is None


def test_where_no_photograph_was_taken_the_split_is_the_picture(room, run):
    darkroom, _, store = room
    here = camera_of(store, 1)
    darkroom.render(replace(here, viewmat=here.viewmat.at[2, 3].add(0.4)))
    settings = Settings(gamma=2.2, mode="split")
    assert not darkroom.photographed_from_here
    np.testing.assert_array_equal(
        darkroom.develop(settings), darkroom.develop(replace(settings, mode="display"))
    )


def test_depth_colours_stay_until_they_are_set_anew(room):
    darkroom, _, store = room
    settings = Settings(gamma=2.2, mode="depth")
    darkroom.develop(settings)
    limits = darkroom.depth_limits
    here = camera_of(store, 1)
    darkroom.render(replace(here, viewmat=here.viewmat.at[2, 3].add(2.0)))
    darkroom.develop(settings)
    assert darkroom.depth_limits == limits
    darkroom.set_depth_limits()
    assert darkroom.depth_limits != limits
