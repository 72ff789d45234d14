"""What one browser's controls do to its display transform, without a browser."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from p2gs_jax.run.read import load_run

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from p2gs_jax.viewer import session as sessions
from p2gs_jax.viewer.session import BrowserSession
from p2gs_jax.viewer.settings import Settings, common_settings, same_display, settings_of_view


class Panel:
    """Controls that hold what they are set to."""

    def __init__(self, start):
        self.now, self.locked, self.at = start, False, None

    def settings(self):
        return self.now

    def put(self, settings):
        self.now = replace(settings, mode=self.now.mode)

    def put_view(self, index, degrees):
        self.at = index

    def set_playing(self, playing):
        pass


@pytest.fixture(scope="module")
def run(finished_run):
    return load_run(finished_run)


@pytest.fixture
def session(run, monkeypatch):
    """Return a session at the photograph in row 1, with +1 EV of the person's own."""
    monkeypatch.setattr(sessions, "browser_view", lambda client: SimpleNamespace(aspect=1.5))
    out = object.__new__(BrowserSession)
    pose = SimpleNamespace(fov=1.0)
    out._run, out._client = run, None
    cache = SimpleNamespace(view_at=lambda camera: 1, nearest_view=lambda camera: 1)
    out._viewed = SimpleNamespace(pose=lambda index, aspect: pose, new_frame_cache=lambda: cache)
    out._render_loop = SimpleNamespace(
        camera_moved=lambda: None, display_changed=lambda: None, camera=lambda seen, size: None
    )
    out._player = SimpleNamespace(stop=lambda: None)
    out._move = lambda pose: None
    out._before_split = out._taken = None
    out._panel = Panel(replace(common_settings(run), exposure_ev=1.0))
    return out


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


def test_looks_are_compared_without_what_is_shown():
    a = Settings(gamma=2.2, exposure_ev=0.5)
    assert same_display(a, replace(a, mode="split", split=0.1, splats=True))
    assert not same_display(a, replace(a, exposure_ev=0.6))
    assert np.isclose(a.gamma, 2.2)
