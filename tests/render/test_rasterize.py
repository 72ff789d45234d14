"""Values and gradients of the fast rasterizer against the float64 oracle and finite differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import street

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import bin_tiles, project, render_linear, required_capacity
from p2gs_jax.render.project import view_radiance

BEHIND = (0.5, 2.0, 7.0)
CFG = RenderConfig(pixels_in_flight=2048, background=BEHIND, stop_error=1e-4)
ORACLE = dataclasses.replace(CFG, implementation="reference")
CAPACITY = 40_000
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def alive_of(g):
    return jnp.ones(g.capacity, bool)


def weights_for(cam):
    rng, shape = np.random.default_rng(0), (cam.height, cam.width)
    return rng.normal(size=(*shape, 3)), rng.normal(size=shape), rng.normal(size=shape) * 0.05


def scalar(g, alive, cam, cfg):
    r = render_linear(g, alive, cam, cfg, CAPACITY)
    a, b, c = (jnp.asarray(w, r.linear.dtype) for w in weights_for(cam))
    return jnp.sum(r.linear * a) + jnp.sum(r.alpha * b) + jnp.sum(r.depth * c), r


SLOPE = jax.jit(jax.grad(scalar, has_aux=True), static_argnums=3)


def slope(g, cam, cfg=CFG, alive=None):
    """Return the gradient of a weighted sum of all outputs, and the outputs, as NumPy arrays."""
    alive = np.ones(g.capacity, bool) if alive is None else alive
    return jax.tree.map(np.asarray, SLOPE(g, alive, cam, cfg))


@pytest.fixture(scope="module")
def oracle():
    """Return the float64 gradient and render of the shared street."""
    with jax.enable_x64(True):
        return slope(*street(dtype=np.float64), ORACLE)


# On a CPU the GPU kernels are interpreted.
@pytest.mark.parametrize(
    ("implementation", "tile", "stop"),
    [
        (None, (16, 8), 1e-4),
        pytest.param("pallas", (16, 8), 1e-4, marks=pytest.mark.slow),
        pytest.param("pallas", (16, 16), None, marks=pytest.mark.slow),
        pytest.param("xla", (8, 8), None, marks=pytest.mark.slow),
        pytest.param("pallas", (32, 4), None, marks=pytest.mark.slow),
    ],
)
def test_values_and_gradients_match_oracle(oracle, implementation, tile, stop):
    v_expected, expected = oracle
    cfg = dataclasses.replace(CFG, tile=tile, stop_error=stop, implementation=implementation)
    # test_hard_cases.py covers atomic sums of gradients.
    cfg = dataclasses.replace(cfg, deterministic=implementation == "pallas")
    g, cam = street()
    v, r = slope(g, cam, cfg)
    assert not bool(r.overflow)
    # The stop rule hides at most its transmittance times the largest value behind it.
    brightest = float(view_radiance(g, cam, cfg).max())
    for name, largest in (("linear", brightest), ("alpha", 1.0), ("depth", 150.0)):
        a, b = getattr(r, name), getattr(expected, name)
        assert np.abs(a - b).max() <= 2e-5 * np.abs(b).max() + (stop or 0) * largest, name
    for name in FIELDS:
        a, b = getattr(v, name), getattr(v_expected, name)
        error = np.linalg.norm(a - b) / np.linalg.norm(b)
        assert error < (2e-4 if stop is None else 1e-3), (name, error)


def test_the_lane_queue_computes_in_the_precision_of_its_input(oracle):
    v_expected, expected = oracle
    # Without the stop rule and the approximate exp only rounding remains.
    cfg = dataclasses.replace(CFG, implementation="xla", stop_error=None, exp_degree=None)
    with jax.enable_x64(True):
        v, r = slope(*street(dtype=np.float64), cfg)
    for name in ("linear", "alpha", "depth"):
        np.testing.assert_allclose(getattr(r, name), getattr(expected, name), rtol=0, atol=1e-11)
    for name in FIELDS:
        a, b = getattr(v, name), getattr(v_expected, name)
        assert np.linalg.norm(a - b) < 1e-11 * np.linalg.norm(b), name


def test_oracle_gradient_matches_finite_differences():
    with jax.enable_x64(True):
        g, cam = street(n=40, width=20, height=15, seed=5, dtype=np.float64)
        # With a vanishing cutoff the image is smooth, so central differences are meaningful.
        cfg = dataclasses.replace(ORACLE, alpha_cutoff=1e-12, blur=0.3)
        f = jax.jit(lambda g: scalar(g, alive_of(g), cam, cfg)[0])
        v, h = slope(g, cam, cfg)[0], 1e-6
        rng = np.random.default_rng(1)
        for name in FIELDS:
            at = getattr(g, name)
            direction = jnp.asarray(rng.normal(size=at.shape))
            ends = [f(dataclasses.replace(g, **{name: at + s * h * direction})) for s in (1, -1)]
            exact = jnp.sum(getattr(v, name) * direction)
            assert abs((ends[0] - ends[1]) / (2 * h) - exact) <= 1e-6 * max(abs(exact), 1.0), name


@pytest.fixture(scope="module")
def shown():
    g, cam = street()
    return g, cam, slope(g, cam)[1].linear


def test_the_order_of_gaussians_does_not_matter(shown):
    g, cam, image = shown
    order = np.random.default_rng(0).permutation(g.capacity)
    shuffled = slope(jax.tree.map(lambda x: np.asarray(x)[order], g), cam)[1].linear
    np.testing.assert_allclose(image, shuffled, atol=1e-5 * float(image.max()))


def test_dead_gaussians_are_as_if_they_were_not_there_and_get_no_gradient(shown):
    g, cam, _ = shown
    alive = np.arange(g.capacity) < 1000
    far = dataclasses.replace(g, means=jnp.where(alive[:, None], g.means, -g.means))
    v, r = slope(g, cam, alive=alive)
    np.testing.assert_allclose(r.linear, slope(far, cam)[1].linear, rtol=1e-5, atol=1e-6)
    for name in FIELDS:
        assert not np.any(np.asarray(getattr(v, name))[1000:]), name
        assert np.any(np.asarray(getattr(v, name))[:1000]), name


@functools.partial(jax.jit, static_argnums=2)
def lists(g, cam, capacity):
    splats = project(g, alive_of(g), cam, CFG)
    return splats, bin_tiles(splats, cam.width, cam.height, capacity, CFG)


def test_an_image_of_one_tile_has_one_list():
    g, cam = street(n=300, width=1, height=1)
    tiles = lists(g, cam, 300)[1]
    assert tiles.offsets.tolist() == [0, int(tiles.count)]
    assert 0 < tiles.count <= 300


def test_tile_lists_match_brute_force_and_overflow_is_reported(shown):
    """Every splat that reaches a pixel centre of a tile is listed there, in depth order."""
    g, cam, _ = shown
    need = int(jax.jit(lambda g: required_capacity(g, alive_of(g), cam, CFG))(g))
    assert lists(g, cam, need - 1)[1].overflow
    splats, tiles = lists(g, cam, need)
    assert int(tiles.count) == need
    assert not tiles.overflow
    ids, offsets = np.asarray(tiles.gaussian_ids), np.asarray(tiles.offsets)
    m, f = np.asarray(splats.means2d, np.float64), np.asarray(splats.conic_factor, np.float64)
    x, y = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
    dx, dy = x[None] - m[:, 0, None, None], y[None] - m[:, 1, None, None]
    a11, a12, a22 = (f[:, i, None, None] for i in range(3))
    e = np.asarray(splats.log_opacities)[:, None, None] - 0.5 * (
        (a11 * dx + a12 * dy) ** 2 + (a22 * dy) ** 2
    )
    across = -(-cam.width // CFG.tile[0])
    for t in range(len(offsets) - 1):
        listed = ids[offsets[t] : offsets[t + 1]]
        assert np.all(np.diff(np.asarray(splats.depths)[listed]) >= 0)
        row, col = divmod(t, across)
        block = e[:, row * 8 : row * 8 + 8, col * 16 : col * 16 + 16]
        assert set(np.nonzero((block > np.log(1 / 255)).any((1, 2)))[0]) <= set(listed.tolist())
        assert len(set(listed.tolist())) == len(listed)


def test_the_background_shows_through(shown):
    g, cam, image = shown
    few = np.arange(g.capacity) < 60
    with jax.enable_x64(True):
        exact = street(dtype=np.float64)
        lit = slope(*exact, ORACLE, few)[1]
        dark = jax.jit(render_linear, static_argnums=(3, 4))(
            exact[0], few, exact[1], dataclasses.replace(ORACLE, background=None), CAPACITY
        )
        through = (1 - lit.alpha)[..., None] * np.array(BEHIND)
        np.testing.assert_allclose(lit.linear, dark.linear + through, rtol=1e-12)
    assert 0.1 < float(lit.alpha.mean()) < 0.9
    found = slope(g, cam, alive=few)[1].linear
    np.testing.assert_allclose(found, lit.linear, rtol=2e-3, atol=2e-3)
    none = slope(g, cam, alive=np.zeros(g.capacity, bool))[1].linear
    np.testing.assert_allclose(none, np.broadcast_to(BEHIND, image.shape))
    empty = jax.tree.map(lambda leaf: leaf[:0], g)
    none = render_linear(empty, alive_of(empty), cam, CFG, 1)
    np.testing.assert_array_equal(none.linear, np.broadcast_to(BEHIND, image.shape))
