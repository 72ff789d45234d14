"""The thread behind one browser's picture, against a browser that only records."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from viewer_stubs import CANVAS, SIZES, Client, FakeRenderer, Panel

from p2gs_jax.errors import UserError
from p2gs_jax.run.read import load_run
from p2gs_jax.viewer import live as live_module
from p2gs_jax.viewer.live import LivePicture
from p2gs_jax.viewer.settings import Settings
from p2gs_jax.viewer.viewed_run import ViewedRun

REST_S = 0.1


@pytest.fixture(scope="module")
def viewed(finished_run):
    out = ViewedRun(load_run(finished_run), 1920)
    out.renderer.stop()
    yield out
    out.store.close()


@pytest.fixture
def setup(viewed, monkeypatch):
    monkeypatch.setattr(live_module, "REST_S", REST_S)
    viewed.renderer = FakeRenderer(viewed.run)
    client, panel = Client(), Panel()
    live = LivePicture(client, viewed, panel)
    yield SimpleNamespace(
        live=live,
        client=client,
        panel=panel,
        renderer=viewed.renderer,
        viewed=viewed,
        pictures=client.pictures,
    )
    live.stop()
    assert viewed.listeners == []


def started(setup):
    setup.live.start()
    setup.client.wait(lambda: sharp(setup))
    return len(setup.pictures)


def sharp(setup, after=0):
    return len(setup.pictures) > after and setup.pictures[-1][0] == "png"


def compiled(setup):
    for listener in tuple(setup.viewed.listeners):
        listener()


def shape(picture):
    return picture[1].shape[1::-1]


def test_it_sharpens_at_rest(setup):
    started(setup)
    assert [kind for kind, *_ in setup.pictures] == ["jpeg", "png"]
    assert shape(setup.pictures[-1]) == CANVAS
    assert set(setup.renderer.wanted[0]) == set(SIZES)
    compiled(setup)  # another size is ready, and none is better
    time.sleep(2 * REST_S)
    assert len(setup.pictures) == 2  # nothing changes, nothing is sent


def test_a_new_look_renders_nothing(setup):
    seen, before = started(setup), len(setup.renderer.rendered)
    for ev in (0.5, 1.0, 2.0):
        setup.panel.now = Settings(gamma=2.2, exposure_ev=ev)
        setup.live.display_changed()
    setup.client.wait(lambda: sharp(setup, seen))
    assert len(setup.renderer.rendered) == before
    assert setup.pictures[-1][1].mean() > setup.pictures[seen - 1][1].mean()


def test_slow_frames_make_small_pictures_while_moving(setup, monkeypatch):
    monkeypatch.setattr("p2gs_jax.viewer.renderer.TARGET_MS", 1e-3)
    seen = started(setup)
    for step in range(2):
        setup.client.camera.position = np.array([0.1 * step, 0, 0])
        setup.live.camera_moved()
        setup.client.wait(lambda: sharp(setup, seen))
    assert {shape(p) for p in setup.pictures if p[0] == "jpeg"} == {SIZES[0]}
    assert shape(setup.pictures[-1]) == CANVAS


def test_the_newest_camera_wins(setup):
    seen = started(setup)
    for step in range(30):
        setup.client.camera.position = np.array([0.02 * step, 0, 0])
        setup.live.camera_moved()
    setup.client.wait(lambda: sharp(setup, seen))
    shown = -setup.live._frame.camera.viewmat[0, 3]
    np.testing.assert_allclose(shown, 0.58 / setup.viewed.space.unit, rtol=1e-5)
    assert len(setup.renderer.rendered) < 32


def test_the_best_there_is_until_more_is_compiled(setup):
    setup.renderer.ready = frozenset(SIZES[:1])
    seen = started(setup)
    assert shape(setup.pictures[-1]) == SIZES[0]
    setup.renderer.ready = frozenset(SIZES)
    compiled(setup)
    setup.client.wait(lambda: len(setup.pictures) > seen)
    assert shape(setup.pictures[-1]) == CANVAS


def test_what_overflows_is_shown_smaller_and_not_tried_again_and_again(setup):
    setup.renderer.refused = {SIZES[-1]}
    seen = started(setup)
    assert shape(setup.pictures[-1]) == SIZES[-2]
    time.sleep(2 * REST_S)
    assert len(setup.pictures) == seen


def test_what_no_size_holds_comes_once_there_is_room(setup):
    started(setup)
    setup.renderer.refused = set(SIZES)
    setup.client.camera.position = np.array([0.4, 0, 0])
    seen = len(setup.pictures)
    setup.live.camera_moved()
    setup.client.wait(lambda: sharp(setup, seen))
    assert setup.live._frame.camera.viewmat[0, 3] == 0
    setup.renderer.refused, seen = set(), len(setup.pictures)
    compiled(setup)
    setup.client.wait(lambda: sharp(setup, seen))
    shown = -setup.live._frame.camera.viewmat[0, 3]
    np.testing.assert_allclose(shown, 0.4 / setup.viewed.space.unit, rtol=1e-5)


@pytest.mark.parametrize("state", ["compiling", "overflowing"])
def test_a_first_view_that_cannot_be_rendered_waits(setup, state):
    if state == "compiling":
        setup.renderer.ready, setup.renderer.compiling = frozenset(), SIZES[1]
    else:
        setup.renderer.refused = set(SIZES)
    setup.live.start()
    time.sleep(4 * REST_S)
    assert not setup.pictures
    assert len(setup.renderer.wanted) == 1  # at rest once, and no busy loop
    assert ("compiling" in setup.panel.status) == (state == "compiling")
    setup.renderer.ready, setup.renderer.refused = frozenset(SIZES), set()
    compiled(setup)
    setup.client.wait(lambda: sharp(setup))


def test_depth_travels_only_where_cameras_are_shown(setup):
    seen = started(setup)
    assert setup.pictures[-1][2]["depth"] is None
    setup.live.with_depth = True
    setup.live.display_changed()
    setup.client.wait(lambda: sharp(setup, seen))
    depth, frame = setup.pictures[-1][2]["depth"], setup.live._frame
    step, opaque = frame.size[0] // depth.shape[1], frame.alpha > 0.9
    assert step == 1
    expected = setup.viewed.space.unit * frame.depth / np.maximum(frame.alpha, 1e-6)
    np.testing.assert_allclose(depth[opaque], np.minimum(expected[opaque], 167), atol=2e-3)
    assert np.all(depth[frame.alpha < 0.4] > 160)


@pytest.mark.parametrize("error", [UserError("no photo"), RuntimeError("no photo")])
def test_a_failing_render_is_said_once_and_the_next_request_is_served(setup, error):
    setup.renderer.broken = error
    setup.live.start()
    time.sleep(4 * REST_S)
    tries = len(setup.renderer.rendered)
    assert tries <= 2  # for the request, and at rest
    assert len(setup.client.said) == tries
    assert all("no photo" in text for text in setup.client.said)
    setup.renderer.broken = None
    setup.live.camera_moved()
    setup.client.wait(lambda: sharp(setup))
    assert len(setup.client.said) == tries


def test_a_failing_development_is_said_and_the_next_picture_comes(setup, monkeypatch):
    seen = started(setup)

    def fail(*_, **__):
        raise UserError("no photo")

    with monkeypatch.context() as patch:
        patch.setattr(setup.live.darkroom, "develop", fail)
        setup.live.display_changed()
        setup.client.wait(lambda: setup.client.said)
        time.sleep(2 * REST_S)
    assert len(setup.client.said) <= 2
    setup.live.display_changed()
    setup.client.wait(lambda: sharp(setup, seen))


def test_the_browser_draws_splats_itself(setup):
    seen = started(setup)
    before = len(setup.renderer.rendered)
    for ev in (0.0, 1.0):
        setup.panel.now = Settings(gamma=2.2, exposure_ev=ev, splats=True)
        setup.live.display_changed()
        setup.client.wait(lambda: "drawn by the browser" in setup.panel.status)
        setup.client.wait(lambda seen=seen: len(setup.pictures) > seen)
        seen = len(setup.pictures)
    (handle,) = setup.client.splats
    assert handle.visible
    assert len(setup.renderer.rendered) == before
    setup.panel.now = Settings(gamma=2.2)
    setup.live.camera_moved()
    setup.client.wait(lambda: sharp(setup, seen) and shape(setup.pictures[-1]) == CANVAS)
    assert not handle.visible
