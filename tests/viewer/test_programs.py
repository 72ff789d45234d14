"""Programs compiled ahead: the renderer's picture, and no wait for longer tile lists."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import RenderConfig
from p2gs_jax.errors import UserError
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.types import Camera, Gaussians
from p2gs_jax.viewer import programs as module
from p2gs_jax.viewer.programs import Programs

CFG = RenderConfig(sh_degree=0)
SIZE, LARGE = (64, 48), (160, 120)


def gaussians(count=200, scale=-3.0):
    rng = np.random.default_rng(0)
    return Gaussians(
        means=jnp.asarray(rng.uniform((-1, -1, 3), (1, 1, 5), (count, 3)), jnp.float32),
        quats=jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        log_scales=jnp.full((count, 3), scale),
        opacity_logits=jnp.zeros(count),
        sh=jnp.asarray(rng.normal(size=(count, 1, 3)), jnp.float32),
    )


def camera(size, z=0.0):
    width, height = size
    K = jnp.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    return Camera(jnp.eye(4).at[2, 3].set(z), K, width, height)


@pytest.fixture
def made():
    """Return a function that makes programs and the event that they compiled something."""
    every = []

    def make(scene, z=0.0):
        changed = threading.Event()
        alive = jnp.ones(scene.capacity, bool)
        out = Programs(scene, alive, CFG, [lambda size: camera(size, z)], changed.set)
        every.append(out)
        return out, changed

    yield make
    for programs in every:
        programs.stop()


def wait_for(programs, changed, size):
    for _ in range(100):
        if size in programs.ready:
            return
        changed.wait(10)
        changed.clear()
    raise AssertionError(f"{size} was never compiled")


def test_renders_what_the_renderer_renders(made):
    scene = gaussians()
    programs, changed = made(scene)
    assert programs.render(camera(SIZE)) is None
    programs.request([SIZE])
    wait_for(programs, changed, SIZE)
    expected = make_renderer(CFG)(scene, jnp.ones(scene.capacity, bool), camera(SIZE, 0.3))
    shown = programs.render(camera(SIZE, 0.3))
    np.testing.assert_allclose(shown.linear, expected.linear, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(shown.depth, expected.depth, rtol=1e-5, atol=1e-6)
    assert programs.took_ms[SIZE] > 0


def test_a_view_that_overflows_comes_as_soon_as_there_is_room(made):
    scene = gaussians(scale=-0.5)
    programs, changed = made(scene, z=-100.0)  # probes look away, so lists are short
    programs.request([LARGE])
    wait_for(programs, changed, LARGE)
    before = programs.compiled
    assert programs.render(camera(LARGE)) is None
    wait_for(programs, changed, LARGE)
    assert programs.compiled > before
    shown = programs.render(camera(LARGE))
    assert not bool(shown.overflow)
    assert float(shown.alpha.max()) > 0.5


def test_a_view_to_save_waits_for_its_program(made):
    programs, _ = made(gaussians(scale=-0.5), z=-100.0)
    shown = programs.render_now(camera(LARGE))
    assert not bool(shown.overflow)
    assert float(shown.alpha.max()) > 0.5


def test_a_view_beyond_all_memory_is_refused(made, monkeypatch):
    monkeypatch.setattr(module, "MOST_ENTRIES", 5000)
    programs, _ = made(gaussians(scale=-0.5), z=-100.0)
    with pytest.raises(UserError, match="memory"):
        programs.render_now(camera(LARGE))


def test_dead_gaussians_are_not_drawn(made):
    scene = gaussians()
    programs = Programs(scene, jnp.zeros(scene.capacity, bool), CFG, [camera])
    assert float(programs.render_now(camera(SIZE)).alpha.max()) == 0
    programs.stop()


def test_an_empty_scene_is_black(made):
    scene = gaussians()
    none = jax.tree.map(lambda leaf: leaf[:0], scene)
    programs, _ = made(none)
    assert not np.asarray(programs.render_now(camera(SIZE)).linear).any()
