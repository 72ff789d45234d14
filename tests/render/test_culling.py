"""Blocks and Gaussians that a view cannot show are left out, and the picture stays bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.render import culling
from p2gs_jax.render.culling import Blocks
from p2gs_jax.render.host import make_renderer
from p2gs_jax.render.visible import in_view
from p2gs_jax.types import Camera, Gaussians

N, SIZE = 3000, (48, 32)
CFG = RenderConfig(sh_degree=0)


@pytest.fixture(scope="module")
def district():
    """Return Gaussians over a square of 100, some wide, some nearly transparent, one nowhere."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-50, 50, (N, 3)) * [1, 0.05, 1]
    means[7] = np.nan
    scales = rng.normal(-1.5, 0.8, (N, 3))
    scales[11] = 4.0
    values = means, rng.normal(size=(N, 4)), scales, rng.normal(0, 3, N), rng.normal(size=(N, 1, 3))
    return Gaussians(*(jnp.asarray(v, jnp.float32) for v in values))


def camera_at(angle, place=(0, 0, 0)):
    c, s = np.cos(angle), np.sin(angle)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.array(place)
    width, height = SIZE
    K = np.array([[50, 0, 20], [0, 55, 18], [0, 0, 1]], np.float32)
    return Camera(on_device(viewmat), on_device(K), width, height, None)


CAMERAS = [camera_at(a, p) for a, p in [(0, (0, 0, 0)), (2, (30, 1, -20)), (4, (90, 0, 0))]]


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(culling, "BLOCK", 64)
    monkeypatch.setattr(culling, "FEWEST", 1000)
    monkeypatch.setattr(culling, "MOST_BLOCKS", 1.0)


@pytest.mark.parametrize("camera", CAMERAS)
def test_no_gaussian_that_may_be_seen_is_left_out(district, small_blocks, camera):
    alive = np.arange(N) % 10 != 3
    blocks = Blocks(district, alive, CFG)
    host = jax.tree.map(np.asarray, district)
    here = Camera(np.asarray(camera.viewmat), np.asarray(camera.K), *SIZE, None)
    finite = np.isfinite(host.means).all(1)
    seen = np.flatnonzero(in_view(host, alive, here, CFG) & finite)
    rows = blocks.of_view(camera)
    assert np.array_equal(rows, seen)
    assert len(rows) < N / 2
    # Blocks alone leave most of it out, too.
    assert blocks.blocks_in_view(camera).mean() < 0.9


def test_pictures_are_the_same_bit_for_bit(district, small_blocks, monkeypatch):
    alive = jnp.arange(N) % 10 != 3
    culled = make_renderer(CFG)
    found = [culled(district, alive, camera) for camera in CAMERAS]
    monkeypatch.setattr(culling, "FEWEST", 10 * N)
    whole = make_renderer(CFG)
    for camera, picture in zip(CAMERAS, found, strict=True):
        expected = whole(district, alive, camera)
        for name in ("linear", "alpha", "depth"):
            a, b = (np.asarray(getattr(r, name)) for r in (picture, expected))
            assert a.tobytes() == b.tobytes(), name
        # What projects beside the image counts as visible only where all are projected.
        visible, projected = (np.asarray(r.visible) for r in (picture, expected))
        assert visible.any()
        assert not (visible & ~projected).any()
    assert float(np.asarray(found[0].alpha).max()) > 0.5


def test_a_view_that_shows_nothing_is_black(district, small_blocks):
    away = camera_at(0, (0, 0, 5000))
    assert len(Blocks(district, np.ones(N, bool), CFG).of_view(away)) == 0
    picture = make_renderer(CFG)(district, jnp.ones(N, bool), away)
    assert not np.asarray(picture.linear).any()
    assert not np.asarray(picture.visible).any()


def test_a_view_of_most_blocks_is_rendered_whole(district, small_blocks, monkeypatch):
    blocks = Blocks(district, np.ones(N, bool), CFG)
    shares = [blocks.blocks_in_view(camera).mean() for camera in CAMERAS]
    monkeypatch.setattr(culling, "MOST_BLOCKS", sorted(shares)[1])
    kept = [blocks.leave_out_much(camera) for camera in CAMERAS]
    assert kept == [share <= sorted(shares)[1] for share in shares]
    assert sum(kept) == 2


def test_another_population_has_other_blocks(district, small_blocks):
    alive, render = jnp.ones(N, bool), make_renderer(CFG)
    first = render(district, alive, CAMERAS[0])
    none = render(district, jnp.zeros(N, bool), CAMERAS[0])
    assert np.asarray(first.alpha).any()
    assert not np.asarray(none.alpha).any()


def test_lengths_are_few_and_hold_what_is_asked(small_blocks):
    rooms = [culling._room(n) for n in range(5000)]
    assert all(room >= n for n, room in enumerate(rooms))
    assert all(room <= max(64, 1.5 * n) for n, room in enumerate(rooms))
    assert len(set(rooms)) < 16
