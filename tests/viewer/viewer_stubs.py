"""A browser that only records, a panel that keeps its settings, and a renderer with faults."""

import contextlib
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.viewer.renderer import _frame, full_size, render_sizes
from p2gs_jax.viewer.settings import Settings

CANVAS = (560, 400)
SIZES = render_sizes(full_size(CANVAS, 1920))
PATIENCE_S = 60


class FakeRenderer:
    """A renderer whose compiled sizes, overflows (`refused`) and error (`broken`) a test sets."""

    def __init__(self, run):
        self.run, self.renderer = run, make_renderer(run.cfg.render)
        self.ready, self.compiling, self.failure = frozenset(SIZES), None, None
        self.rendered, self.wanted, self.refused, self.broken = [], [], set(), None

    def request(self, sizes):
        self.wanted.append(tuple(sizes))

    def render(self, camera):
        size = (camera.width, camera.height)
        return self.render_now(camera) if size in self.ready - self.refused else None

    def render_now(self, camera):
        self.rendered.append((camera.width, camera.height))
        if self.broken is not None:
            raise self.broken
        return _frame(self.renderer(self.run.params.gaussians, self.run.alive, camera), camera)


class Client:
    def __init__(self):
        self.pictures, self.notices, self.files = [], [], []
        self.came = threading.Condition()
        self.scene = SimpleNamespace(set_background_image=self.show)
        place = {"wxyz": np.array([1.0, 0, 0, 0]), "position": np.zeros(3), "fov": 0.9}
        size = {"image_width": CANVAS[0], "image_height": CANVAS[1]}
        more = {"look_at": np.array([0.0, 0, 1]), "on_update": lambda call: None}
        self.camera = SimpleNamespace(**place, **size, **more)
        self.gui, self.atomic, self.flush = None, contextlib.nullcontext, lambda: None

    def keep(self, where, item):
        with self.came:
            where.append(item)
            self.came.notify_all()

    def show(self, image, kind, **more):
        self.keep(self.pictures, (kind, image, more))

    def add_notification(self, title, body, **more):
        self.keep(self.notices, body)
        return SimpleNamespace(remove=lambda: None)

    def send_file_download(self, name, content, **more):
        self.files.append((name, content))

    def wait(self, holds):
        with self.came:
            assert self.came.wait_for(holds, PATIENCE_S), (len(self.pictures), self.notices)

    def wait_sharp(self, after=0):
        self.wait(lambda: len(self.pictures) > after and self.pictures[-1][0] == "png")
        return len(self.pictures)


class Panel:
    def __init__(self, start=None):
        self.now, self.at = start or Settings(gamma=2.2), None
        self.locked = SimpleNamespace(value=False)
        self.status = self.legend = None

    def settings(self):
        return self.now

    def put(self, settings):
        self.now = replace(settings, mode=self.now.mode)

    def put_view(self, index, degrees):
        self.at = index

    def set_status(self, html):
        self.status = html

    def set_legend(self, html):
        self.legend = html
