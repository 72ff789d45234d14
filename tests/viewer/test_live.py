"""The thread that makes a browser's pictures, and the effects of controls, without a browser."""

import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

import viser
from viewer_stubs import CANVAS, SIZES, Client, FakeRenderer, Panel

from p2gs_jax import UserError, load_run
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.scene.pixels.store import camera_of
from p2gs_jax.viewer import live as live_module
from p2gs_jax.viewer import panel as panels
from p2gs_jax.viewer import renderer as renderer_module
from p2gs_jax.viewer import session as sessions
from p2gs_jax.viewer.live import Darkroom, LivePicture
from p2gs_jax.viewer.session import BrowserSession
from p2gs_jax.viewer.settings import (
    Settings,
    common_settings,
    display_of,
    exposures_ev,
    settings_of_view,
)
from p2gs_jax.viewer.viewed_run import ViewedRun

REST_S = 0.1


@pytest.fixture(scope="module")
def kept(finished_run):
    out = ViewedRun(load_run(finished_run), 1920)
    out.renderer.stop()
    yield out
    out.store.close()


@pytest.fixture
def viewed(kept, monkeypatch):
    monkeypatch.setattr(live_module, "REST_S", REST_S)
    kept.renderer = FakeRenderer(kept.run)
    return kept


@pytest.fixture(scope="module")
def run(kept):
    return kept.run


@pytest.fixture
def client():
    return Client()


@pytest.fixture
def setup(viewed, client):
    panel = Panel()
    live = LivePicture(client, viewed, panel)
    renderer, pictures = viewed.renderer, client.pictures
    yield SimpleNamespace(live=live, panel=panel, renderer=renderer, pictures=pictures)
    live.stop()
    assert viewed.listeners == []


@pytest.fixture
def seen(setup, client):
    """Start the thread; return the number of pictures up to the first one at rest."""
    setup.live.start()
    return client.wait_sharp()


def compiled(viewed):
    for listener in tuple(viewed.listeners):
        listener()


def shape(picture):
    return picture[1].shape[1::-1]


def move(setup, client, x):
    client.camera.position = np.array([x, 0, 0])
    setup.live.post("camera")


def shown_at(setup, viewed):
    return -float(setup.live._frame.camera.viewmat[0, 3]) * viewed.space.unit


def test_the_picture_sharpens_at_rest(setup, seen, viewed):
    assert [kind for kind, *_ in setup.pictures] == ["jpeg", "png"]
    assert shape(setup.pictures[-1]) == CANVAS
    assert set(setup.renderer.wanted[0]) == set(SIZES)
    compiled(viewed)  # no size is better than the one shown
    time.sleep(2 * REST_S)
    assert len(setup.pictures) == 2  # nothing changes, nothing is sent


def test_a_new_look_needs_no_new_render(setup, client, seen):
    before = len(setup.renderer.rendered)
    for ev in (0.5, 1.0, 2.0):
        setup.panel.now = Settings(gamma=2.2, exposure_ev=ev)
        setup.live.post("look")
    client.wait_sharp(seen)
    assert len(setup.renderer.rendered) == before
    assert setup.pictures[-1][1].mean() > setup.pictures[seen - 1][1].mean()


def test_slow_frames_make_small_pictures_while_moving(setup, client, monkeypatch):
    monkeypatch.setattr(renderer_module, "TARGET_MS", 1e-3)
    setup.live.start()
    seen = client.wait_sharp()
    for x in (0.1, 0.2):
        move(setup, client, x)
        seen = client.wait_sharp(seen)
    assert {shape(p) for p in setup.pictures if p[0] == "jpeg"} == {SIZES[0]}
    assert shape(setup.pictures[-1]) == CANVAS


def test_the_newest_camera_wins(setup, client, viewed, seen):
    for step in range(30):
        move(setup, client, 0.02 * step)
    client.wait_sharp(seen)
    assert shown_at(setup, viewed) == pytest.approx(0.58)
    assert len(setup.renderer.rendered) < 32


def test_the_largest_ready_size_that_has_room_is_shown(setup, client, viewed):
    setup.renderer.ready, setup.renderer.refused = frozenset(SIZES[:1]), {SIZES[-1]}
    setup.live.start()
    seen = client.wait_sharp()
    assert shape(setup.pictures[-1]) == SIZES[0]
    setup.renderer.ready = frozenset(SIZES)
    compiled(viewed)
    seen = client.wait_sharp(seen)
    assert shape(setup.pictures[-1]) == SIZES[-2]
    time.sleep(2 * REST_S)
    assert len(setup.pictures) == seen  # the refused size is not tried again
    setup.renderer.refused = set(SIZES)
    move(setup, client, 0.4)
    seen = client.wait_sharp(seen)
    assert shown_at(setup, viewed) == 0
    setup.renderer.refused = set()
    compiled(viewed)
    client.wait_sharp(seen)
    assert shown_at(setup, viewed) == pytest.approx(0.4)


@pytest.mark.parametrize("state", ["compiling", "overflowing"])
def test_a_first_view_that_cannot_be_rendered_waits(setup, client, viewed, state):
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
    compiled(viewed)
    client.wait_sharp()


@pytest.mark.parametrize("error", [UserError("no photo"), RuntimeError("no photo")])
@pytest.mark.parametrize("part", ["render", "develop"])
def test_a_failure_is_shown_once_and_pictures_go_on(setup, client, monkeypatch, error, part):
    with monkeypatch.context() as patch:
        if part == "render":
            patch.setattr(setup.renderer, "broken", error)
        else:
            patch.setattr(setup.live.darkroom, "develop", MagicMock(side_effect=error))
        setup.live.start()
        time.sleep(4 * REST_S)
        count = len(client.notices)
        assert 1 <= count <= 2  # for the request, and at rest
        assert all("no photo" in text for text in client.notices)
    setup.live.post("camera")
    client.wait_sharp()
    assert len(client.notices) == count


@pytest.fixture
def frame(viewed):
    return viewed.renderer.render_now(camera_of(viewed.store, 1))


def moved(frame, axis, by):
    viewmat = frame.camera.viewmat.at[axis, 3].add(by)
    return replace(frame, camera=replace(frame.camera, viewmat=viewmat))


def test_exposures_count_from_the_mean_whatever_the_gauge(run):
    old = run.params.photometry
    shifted = replace(old, raw_exposures=old.raw_exposures + 1.3)
    other = replace(run, params=replace(run.params, photometry=shifted))
    index = run.scene.train_indices[1]
    settings = settings_of_view(other, index, common_settings(other))
    expected = other.own_display(index).exposure
    assert display_of(other, settings).exposure == pytest.approx(expected, rel=1e-5)
    assert settings.exposure_ev == pytest.approx(exposures_ev(run)[index], abs=1e-5)


def test_corrections_hold_under_the_curve_they_were_learned_with(run):
    shape = (len(run.scene.train_indices), 3, 4)
    corrections = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    photometry = replace(run.cfg.photometry, appearance="affine")
    params = replace(run.params, appearance=corrections)
    corrected = replace(run, params=params, cfg=replace(run.cfg, photometry=photometry))
    settings = settings_of_view(corrected, run.scene.train_indices[2], Settings(gamma=2.2))
    np.testing.assert_array_equal(display_of(corrected, settings).correction, corrections[2])
    mean = display_of(corrected, replace(settings, view=None))
    np.testing.assert_allclose(mean.correction, corrections.mean(0), atol=1e-6)
    assert display_of(corrected, replace(settings, curve="linear")).correction is None


def test_the_split_shows_the_photograph_beside_the_render(viewed, frame, run):
    darkroom = Darkroom(viewed)
    settings = settings_of_view(run, 1, Settings(gamma=2.2, mode="split", split=0.5))
    shown, photo = darkroom.develop(frame, settings), viewed.store.get(1)[0]
    width = photo.shape[1]
    left, right = np.s_[2:-2, 2 : width // 2 - 3], np.s_[:, width // 2 + 3 :]
    np.testing.assert_allclose(shown[left], photo[left], atol=2e-3)
    rendered = darkroom.develop(frame, replace(settings, mode="display"))
    np.testing.assert_array_equal(shown[right], rendered[right])
    # The render resembles the photograph, so the halves match.
    assert np.mean(np.abs(rendered[left] - photo[left])) < 0.15


def test_without_a_photograph_the_split_is_the_render(viewed, frame, run, monkeypatch):
    darkroom = Darkroom(viewed)
    assert viewed.view_at(frame.camera) == 1
    split = replace(common_settings(run), mode="split")
    plain = darkroom.develop(frame, replace(split, mode="display"))
    with monkeypatch.context() as patch:
        patch.setattr(viewed.store, "get", MagicMock(side_effect=UserError("<0.png> is torn.")))
        np.testing.assert_array_equal(darkroom.develop(frame, split), plain)
        assert "&lt;0.png&gt; is torn." in darkroom.legend(frame, split)
    assert np.any(darkroom.develop(frame, split) != plain)
    assert darkroom.legend(frame, split) is None
    away = moved(frame, 2, 0.4)
    assert viewed.view_at(away.camera) is None
    assert viewed.nearest_view(moved(frame, 0, 0.05).camera) == 1
    np.testing.assert_array_equal(darkroom.develop(away, split), plain)
    assert "No photograph" in darkroom.legend(away, split)


@pytest.fixture
def session(viewed, client, monkeypatch):
    """Return a session at the photograph in row 1 whose user has set +1 EV."""
    panel = Panel(replace(common_settings(viewed.run), exposure_ev=1.0))
    monkeypatch.setattr(sessions, "Panel", lambda gui, viewed, actions: panel)
    out = BrowserSession(client, viewed)
    out._move(viewed.pose(1, CANVAS))
    yield out
    out.stop()


def show(session, mode):
    session._panel.now = replace(session._panel.now, mode=mode)
    session.mode_changed()


def test_a_split_sets_the_exposure_of_the_photograph(session, run):
    photo = settings_of_view(run, 1, session._panel.now)
    show(session, "split")
    assert session._panel.now.exposure_ev == pytest.approx(photo.exposure_ev)
    assert session._panel.now.exposure_ev != 1.0


def test_the_exposure_can_be_locked(session):
    session._panel.locked.value = True
    before = session._panel.now
    session.go_to(2)
    assert (session._panel.at, session._panel.now) == (2, before)
    show(session, "split")
    show(session, "display")
    assert session._panel.now == before
    session._panel.locked.value = False
    session.go_to(2)
    assert session._panel.now.view == 2


def test_a_view_is_saved_also_after_a_failure(session, viewed, client):
    for error in (UserError("too much memory"), RuntimeError("too much memory")):
        viewed.renderer.broken = error
        session.save("png", 100)
        assert "too much memory" in client.notices[-1]
        assert client.files == []
    viewed.renderer.broken = None
    session.save("png", 100)
    session.save("exr", 100)
    (png, content), (exr, light) = client.files
    assert png.startswith("run_")
    assert exr.endswith(".exr")
    assert light[:4] == b"\x76\x2f\x31\x01"
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (round(100 * CANVAS[1] / CANVAS[0]), 100, 3)


def test_the_panel_returns_the_settings_that_were_put(viewed, run):
    server, actions = viser.ViserServer(port=0, verbose=False), MagicMock()
    try:
        panel = panels.Panel(server.gui, viewed, actions)
        assert panel.settings() == common_settings(run)
        wanted = settings_of_view(run, 1, panel.settings())
        panel.put(wanted)
        panel.put_view(2, 50.0)
        panel.set_legend("legend")
        assert panel.settings() == replace(wanted, exposure_ev=pytest.approx(wanted.exposure_ev))
        assert not panel.locked.value
        last = read_jsonl(run.folder / "log.jsonl")[-1]
        panel.show_training([last | {"step": k, "loss": 1 / k} for k in range(1, 2001)])
        assert f"step 2000 of {last['steps']}, loss 0.0005" in panel._progress.content
        loss, exposures = (chart.data for chart in panel._charts)
        assert (loss[0][0], loss[0][-1], loss[1][-1]) == (1, 2000, 1 / 2000)
        assert len(loss[0]) <= panels.MOST_RECORDS
        assert dict(zip(*exposures, strict=True)) == pytest.approx(exposures_ev(run))
    finally:
        server.stop()
    assert not actions.method_calls  # only a user's clicks call them
