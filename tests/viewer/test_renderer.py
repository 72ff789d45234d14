"""The renderer with programs compiled ahead: its pictures, overflows, failures and sizes."""

import threading
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from splats import random_splats

from p2gs_jax import Camera, RenderConfig, UserError
from p2gs_jax.render.capacity import make_renderer

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from p2gs_jax.viewer import renderer as renderers

CFG = RenderConfig(sh_degree=0)
SIZE, LARGE = (64, 48), (160, 120)
SIZES = ((320, 200), (480, 300), (1280, 800))


def gaussians(count=200, scale=-3.0):
    means = np.random.default_rng(0).uniform((-1, -1, 3), (1, 1, 5), (count, 3))
    g, zeros = random_splats(count, degree=0), jnp.zeros(count)
    scales = jnp.full((count, 3), scale)
    return replace(g, means=jnp.float32(means), log_scales=scales, opacity_logits=zeros)


def camera(size, z=0.0):
    width, height = size
    K = jnp.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    return Camera(jnp.eye(4).at[2, 3].set(z), K, width, height)


@pytest.fixture
def made(monkeypatch):
    """Return a function that makes a renderer and the event that is set after compilations."""
    monkeypatch.setattr("p2gs_jax.render.capacity.SMALLEST", 4096)
    every = []

    def make(scene, z=0.0, alive=True):
        changed = threading.Event()
        used = jnp.full(scene.capacity, alive)
        out = renderers.Renderer(scene, used, CFG, [lambda size: camera(size, z)], changed.set)
        every.append(out)
        return out, changed

    yield make
    for renderer in every:
        renderer.stop()


def wait_for(renderer, changed, size):
    for _ in range(100):
        if size in renderer.ready:
            return
        changed.wait(10)
        changed.clear()
    raise AssertionError(f"{size} was never compiled")


def test_the_viewer_renders_the_same_as_make_renderer(made):
    scene = gaussians()
    renderer, changed = made(scene)
    assert renderer.render(camera(SIZE)) is None
    renderer.request([SIZE])
    wait_for(renderer, changed, SIZE)
    expected = make_renderer(CFG)(scene, jnp.ones(scene.capacity, bool), camera(SIZE, 0.3))
    shown = renderer.render(camera(SIZE, 0.3))
    np.testing.assert_allclose(shown.linear, expected.linear, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(shown.depth, expected.depth, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("count", [200, 150])
def test_other_gaussians_are_shown_by_the_same_program_if_their_number_stays(made, count):
    renderer, changed = made(gaussians())
    renderer.request([SIZE])
    wait_for(renderer, changed, SIZE)
    other = gaussians(count, scale=-2.0)
    renderer.show(other, jnp.ones(count, bool))
    if count == 200:
        assert renderer.compiling is None
    wait_for(renderer, changed, SIZE)
    expected = make_renderer(CFG)(other, jnp.ones(count, bool), camera(SIZE))
    shown = renderer.render(camera(SIZE))
    np.testing.assert_allclose(shown.linear, expected.linear, rtol=1e-5, atol=1e-6)


def test_a_view_that_overflows_comes_as_soon_as_there_is_room(made):
    renderer, changed = made(gaussians(scale=-0.5), z=-100.0)  # probes look away: short lists
    renderer.request([LARGE])
    wait_for(renderer, changed, LARGE)
    assert renderer.render(camera(LARGE)) is None
    wait_for(renderer, changed, LARGE)
    assert float(renderer.render(camera(LARGE)).alpha.max()) > 0.5


def test_a_view_to_save_waits_for_its_program(made, monkeypatch):
    renderer, _ = made(gaussians(scale=-0.5), z=-100.0)
    assert float(renderer.render_now(camera(LARGE)).alpha.max()) > 0.5
    monkeypatch.setattr(renderers, "MOST_ENTRIES", 5000)
    with pytest.raises(UserError, match="memory"):
        renderer.render_now(camera(LARGE))


def test_a_size_that_cannot_be_compiled_is_reported_and_the_next_one_is_compiled(made, monkeypatch):
    renderer, changed = made(gaussians())
    monkeypatch.setattr(renderer, "_probes", [lambda size: 1 / (size != LARGE) and camera(size)])
    renderer.request([LARGE, SIZE])
    wait_for(renderer, changed, SIZE)
    assert renderer.failure.startswith("160 x 120 cannot be compiled")


def test_sizes_rise_to_the_canvas_itself_up_to_a_width():
    assert renderers.full_size((1280, 800), 1920) == (1280, 800)
    assert renderers.full_size((3840, 2160), 1920) == (1920, 1080)
    assert renderers.full_size((0, 0), 1920) == (1, 1)
    for canvas in ((1280, 800), (1920, 950), (600, 1000), (200, 150), (1, 1)):
        sizes = renderers.render_sizes(canvas)
        areas = [w * h for w, h in sizes]
        assert areas == sorted(set(areas))
        assert sizes[-1] == canvas
        assert set(renderers.compilation_order(sizes)) == set(sizes)
        assert all(w % 8 == h % 8 == 0 for w, h in sizes[:-1])


def ms(size, of, share):
    """Return the time, ms, of a frame at which one of size `of` takes a share of the target."""
    return share * renderers.TARGET_MS * size[0] * size[1] / (of[0] * of[1])


@pytest.mark.parametrize(
    ("ready", "current", "took", "wanted"),
    [
        (SIZES, None, 0.0, SIZES[0]),
        (SIZES, (640, 400), 1.0, SIZES[0]),  # of another window
        # One step at a time, if the next size is clearly fast enough.
        (SIZES, SIZES[0], ms(SIZES[0], SIZES[1], renderers.ENLARGE_WITHIN - 0.01), SIZES[1]),
        (SIZES, SIZES[0], ms(SIZES[0], SIZES[1], renderers.ENLARGE_WITHIN + 0.01), SIZES[0]),
        (SIZES, SIZES[2], 0.1, SIZES[2]),
        # A size is kept until it is clearly too slow, and left for the largest that keeps up.
        (SIZES, SIZES[2], (renderers.SHRINK_BEYOND - 0.01) * renderers.TARGET_MS, SIZES[2]),
        (SIZES, SIZES[2], 2 * renderers.TARGET_MS, SIZES[1]),
        # Only compiled sizes are chosen; those of another window serve until then.
        (SIZES[1:2], SIZES[1], 0.1, SIZES[1]),
        ((), None, 0.0, None),
        (((336, 192), (2000, 1000)), None, 0.0, (336, 192)),
    ],
)
def test_the_next_size_keeps_up(ready, current, took, wanted):
    assert renderers.next_size(SIZES, ready, current, took) == wanted
