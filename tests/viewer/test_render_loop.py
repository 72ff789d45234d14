"""The thread behind one browser's picture, against a browser that only records."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.viewer.browser_camera import ViewerSpace
from p2gs_jax.viewer.frame_cache import FrameCache
from p2gs_jax.viewer.render_sizes import full_size, render_sizes
from p2gs_jax.viewer.settings import Settings

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from p2gs_jax.viewer.render_loop import RenderLoop

CANVAS = (560, 400)
SIZES = render_sizes(full_size(CANVAS, 1920))
PATIENCE_S = 60


class Programs:
    """What is compiled and how long it takes, as a test wants it."""

    def __init__(self, run):
        self.run, self.renderer = run, make_renderer(run.cfg.render)
        self.ready, self.took_ms = frozenset(SIZES), dict.fromkeys(SIZES, 1.0)
        self.compiled, self.compiling, self.failure = len(SIZES), None, None
        self.rendered, self.wanted, self.refused = [], [], set()

    def request(self, sizes):
        self.wanted.append(tuple(sizes))

    def render(self, camera):
        size = (camera.width, camera.height)
        if size not in self.ready or size in self.refused:
            return None
        self.rendered.append(size)
        return self.renderer(self.run.params.gaussians, self.run.alive, camera)


class Client:
    """A browser."""

    def __init__(self):
        self.pictures, self.said = [], []
        self.came = threading.Condition()
        self.scene = SimpleNamespace(set_background_image=self.show)
        self.camera = SimpleNamespace(
            wxyz=np.array([1.0, 0, 0, 0]),
            position=np.zeros(3),
            fov=0.9,
            image_width=CANVAS[0],
            image_height=CANVAS[1],
        )

    def show(self, image, kind, **more):
        with self.came:
            self.pictures.append((kind, image, more))
            self.came.notify_all()

    def flush(self):
        pass

    def add_notification(self, title, body, **more):
        self.said.append(body)

    def wait(self, holds):
        with self.came:
            assert self.came.wait_for(lambda: holds(self.pictures), PATIENCE_S), len(self.pictures)


class Panel:
    """Settings, and no controls."""

    def __init__(self):
        self.now = Settings(gamma=2.2)

    def settings(self):
        return self.now

    def set_status(self, html):
        self.status = html

    def set_legend(self, html):
        self.legend = html


@pytest.fixture(scope="module")
def run(finished_run):
    return load_run(finished_run)


@pytest.fixture
def setup(run):
    store = ImageStore(run.scene.views, run.cfg.data)
    programs, client, panel = Programs(run), Client(), Panel()
    viewed = SimpleNamespace(
        run=run,
        programs=programs,
        space=ViewerSpace(2.0, np.array([0.0, -1, 0])),
        max_width=1920,
        listeners=[],
        new_frame_cache=lambda: FrameCache(run, store, programs, 4.0),
    )
    loop = RenderLoop(client, viewed, panel)
    yield SimpleNamespace(loop=loop, client=client, panel=panel, programs=programs, viewed=viewed)
    loop.stop()
    store.close()


def sharp(pictures):
    return bool(pictures) and pictures[-1][0] == "png"


def shape(picture):
    return picture[1].shape[1::-1]


def test_it_sharpens_at_rest(setup):
    setup.loop.start()
    setup.client.wait(sharp)
    kinds = [kind for kind, *_ in setup.client.pictures]
    assert kinds == ["jpeg", "png"]
    assert shape(setup.client.pictures[-1]) == CANVAS
    assert set(setup.programs.wanted[0]) == set(SIZES)
    time.sleep(0.5)
    assert len(setup.client.pictures) == 2  # nothing changes, nothing is sent


def test_a_new_look_renders_nothing(setup):
    setup.loop.start()
    setup.client.wait(sharp)
    before, seen = len(setup.programs.rendered), len(setup.client.pictures)
    for ev in (0.5, 1.0, 2.0):
        setup.panel.now = Settings(gamma=2.2, exposure_ev=ev)
        setup.loop.display_changed()
        setup.client.wait(lambda p: len(p) > seen)
    setup.client.wait(lambda p: len(p) > seen and sharp(p))
    assert len(setup.programs.rendered) == before
    pictures = setup.client.pictures
    assert pictures[-1][1].mean() > pictures[seen - 1][1].mean()


def test_slow_frames_make_small_pictures_while_moving(setup):
    setup.programs.took_ms = {size: 1e4 for size in SIZES}
    setup.loop.start()
    setup.client.wait(sharp)
    assert shape(setup.client.pictures[0]) == SIZES[0]
    assert shape(setup.client.pictures[-1]) == CANVAS


def test_the_newest_camera_wins(setup):
    setup.loop.start()
    setup.client.wait(sharp)
    for step in range(30):
        setup.client.camera.position = np.array([0.02 * step, 0, 0])
        setup.loop.camera_moved()
    setup.client.wait(sharp)
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        shown = setup.loop.frame_cache.frame.camera.viewmat[0, 3]
        if np.isclose(shown, -0.58 / 2.0, atol=1e-5):
            break
        time.sleep(0.05)
    assert np.isclose(shown, -0.58 / 2.0, atol=1e-5)
    assert len(setup.programs.rendered) < 32


def test_the_best_there_is_until_more_is_compiled(setup):
    setup.programs.ready = frozenset(SIZES[:1])
    setup.loop.start()
    setup.client.wait(sharp)
    assert shape(setup.client.pictures[-1]) == SIZES[0]
    setup.programs.ready, setup.programs.compiled = frozenset(SIZES), 99
    for listener in setup.viewed.listeners:
        listener()
    setup.client.wait(lambda p: shape(p[-1]) == CANVAS)


def test_what_overflows_is_shown_smaller(setup):
    setup.programs.refused = {SIZES[-1]}
    setup.loop.start()
    setup.client.wait(sharp)
    assert shape(setup.client.pictures[-1]) == SIZES[-2]
    time.sleep(0.5)
    sent = len(setup.client.pictures)
    time.sleep(0.5)
    assert len(setup.client.pictures) == sent  # it does not try again and again


def test_what_no_size_holds_comes_once_there_is_room(setup):
    setup.loop.start()
    setup.client.wait(sharp)
    setup.programs.refused = set(SIZES)
    setup.client.camera.position = np.array([0.4, 0, 0])
    setup.loop.camera_moved()
    time.sleep(0.7)
    assert setup.loop.frame_cache.frame.camera.viewmat[0, 3] == 0
    seen = len(setup.client.pictures)
    setup.programs.refused, setup.programs.compiled = set(), 99
    for listener in setup.viewed.listeners:
        listener()
    setup.client.wait(lambda p: len(p) > seen and sharp(p))
    np.testing.assert_allclose(setup.loop.frame_cache.frame.camera.viewmat[0, 3], -0.2)


def test_nothing_compiled_shows_nothing_and_waits(setup):
    setup.programs.ready = frozenset()
    setup.programs.compiling = SIZES[1]
    setup.loop.start()
    assert not setup.client.pictures
    assert "compiling" in setup.panel.status
    setup.programs.ready, setup.programs.compiling = frozenset(SIZES), None
    for listener in setup.viewed.listeners:
        listener()
    setup.client.wait(sharp)


def test_depth_travels_only_where_cameras_are_shown(setup):
    setup.loop.start()
    setup.client.wait(sharp)
    assert setup.client.pictures[-1][2]["depth"] is None
    setup.loop.with_depth = True
    seen = len(setup.client.pictures)
    setup.loop.display_changed()
    setup.client.wait(lambda p: len(p) > seen)
    depth = setup.client.pictures[-1][2]["depth"]
    frame = setup.loop.frame_cache.frame
    opaque = frame.alpha > 0.9
    expected = 2.0 * frame.depth / np.maximum(frame.alpha, 1e-6)
    np.testing.assert_allclose(depth[opaque], expected[opaque], atol=2e-3)
    assert np.all(depth[frame.alpha < 0.4] > 160)


def test_an_error_is_said_and_the_next_picture_comes(setup, monkeypatch):
    setup.loop.start()
    setup.client.wait(sharp)
    develop = setup.loop.frame_cache.develop

    def fail(*_, **__):
        raise UserError("no photo")

    monkeypatch.setattr(setup.loop.frame_cache, "develop", fail)
    setup.loop.display_changed()
    end = time.monotonic() + PATIENCE_S
    while not setup.client.said and time.monotonic() < end:
        time.sleep(0.02)
    assert setup.client.said[0] == "no photo"
    monkeypatch.setattr(setup.loop.frame_cache, "develop", develop)
    seen = len(setup.client.pictures)
    setup.loop.display_changed()
    setup.client.wait(lambda p: len(p) > seen)
