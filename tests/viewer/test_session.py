"""What one browser's controls do to its display transform, and files; without a browser."""

from dataclasses import replace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

import viser
from viewer_stubs import CANVAS, Client, FakeRenderer, Panel

from p2gs_jax.errors import UserError
from p2gs_jax.run.read import load_run
from p2gs_jax.viewer import session as sessions
from p2gs_jax.viewer.panel import Panel as RealPanel
from p2gs_jax.viewer.session import BrowserSession
from p2gs_jax.viewer.settings import Settings, common_settings, same_display, settings_of_view
from p2gs_jax.viewer.viewed_run import ViewedRun


@pytest.fixture(scope="module")
def viewed(finished_run):
    out = ViewedRun(load_run(finished_run), 1920)
    out.renderer.stop()
    out.renderer = FakeRenderer(out.run)
    yield out
    out.store.close()


@pytest.fixture
def run(viewed):
    return viewed.run


@pytest.fixture
def client():
    return Client()


@pytest.fixture
def session(viewed, client, monkeypatch):
    """Return a session at the photograph in row 1, with +1 EV of the person's own."""
    panel = Panel(replace(common_settings(viewed.run), exposure_ev=1.0))
    monkeypatch.setattr(sessions, "Panel", lambda gui, viewed, actions: panel)
    out = BrowserSession(client, viewed)
    out._move(viewed.pose(1, CANVAS[0] / CANVAS[1]))
    yield out
    out.stop()


def show(session, mode):
    session._panel.now = replace(session._panel.now, mode=mode)
    session.mode_changed()


def test_a_split_gives_the_look_back(session, run):
    before = session._panel.now
    show(session, "split")
    own = settings_of_view(run, 1, before)
    assert session._panel.now.exposure_ev == pytest.approx(own.exposure_ev)
    assert session._panel.now.exposure_ev != 1.0
    session.go_to(2)
    show(session, "display")
    assert session._panel.now == before


def test_a_look_chosen_during_a_split_stays(session):
    show(session, "split")
    session._panel.now = replace(session._panel.now, exposure_ev=2.5)
    show(session, "display")
    assert session._panel.now.exposure_ev == 2.5
    show(session, "depth")
    assert session._panel.now.exposure_ev == 2.5


def test_the_exposure_can_be_locked(session):
    session._panel.locked = True
    before = session._panel.now
    session.go_to(2)
    assert (session._panel.at, session._panel.now) == (2, before)
    show(session, "split")
    show(session, "display")
    assert session._panel.now == before
    session._panel.locked = False
    session.go_to(2)
    assert session._panel.now.taken_as == 2


def test_a_metered_exposure_stays_where_it_was_when_switched_off(session, run):
    session.set_metered(True)
    assert session._panel.now.metered
    assert session._panel.now.exposure_ev == 0
    session._live.darkroom.metered_exposure = 4 * run.mean.exposure_geometric
    session.set_metered(False)
    assert session._panel.now.exposure_ev == pytest.approx(2)


def test_what_cannot_be_metered_is_not(session, client, monkeypatch):
    def fail(run):
        raise UserError("no photographs")

    monkeypatch.setattr(type(session._run), "metering", property(fail))
    session.set_metered(True)
    assert client.said[-1] == "no photographs"
    assert not session._panel.now.metered


def test_a_view_is_saved_also_after_a_failure(session, viewed, client):
    for error in (UserError("too much memory"), RuntimeError("too much memory")):
        viewed.renderer.broken = error
        session.save("png", 100)
        assert "too much memory" in client.said[-1]
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


def test_the_panel_holds_what_it_is_set_to(viewed, run):
    server, actions = viser.ViserServer(port=0, verbose=False), MagicMock()
    try:
        panel = RealPanel(server.gui, viewed, actions)
        assert panel.settings() == common_settings(run)
        wanted = settings_of_view(run, 1, panel.settings())
        panel.put(wanted)
        panel.put_view(2, 50.0)
        panel.put_place(1.0)
        panel.set_playing(True)
        panel.set_status("status")
        panel.set_legend("legend")
        assert panel.settings() == replace(wanted, exposure_ev=pytest.approx(wanted.exposure_ev))
        assert panel.drive == (run.scene.views[0].camera, 1.0)
        assert (panel.speed, panel.locked, panel.own_exposures) == (2.0, False, False)
    finally:
        server.stop()
    assert not actions.method_calls  # these are a person's alone


def test_looks_are_compared_without_what_is_shown():
    a = Settings(gamma=2.2, exposure_ev=0.5)
    assert same_display(a, replace(a, mode="split", split=0.1, splats=True))
    assert not same_display(a, replace(a, exposure_ev=0.6))
