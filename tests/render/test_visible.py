"""Gaussians in view are all listed, the host counts no fewer, and lists grow on demand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splats import gaussians_of

from p2gs_jax import Camera, Gaussians, RenderConfig
from p2gs_jax.render import bin_tiles, project, required_capacity
from p2gs_jax.render.capacity import SMALLEST, bucket, until_it_fits
from p2gs_jax.render.visible import compact, in_view
from p2gs_jax.train.capacities import count_view

COUNT, WIDTH, HEIGHT = 300, 80, 56
# Every Gaussian in each of 5 x 7 tiles.
CAPACITY = COUNT * 5 * 7


def scene(seed: int, spread: float, size: float, shape: float, near: float) -> Gaussians:
    """Return Gaussians around the camera: far and near, round and elongated, opaque and not."""
    rng = np.random.default_rng(seed)
    means = spread * rng.normal(size=(COUNT, 3))
    means[: COUNT // 4, 2] = near * rng.uniform(0.5, 2, COUNT // 4)
    quats, scales = rng.normal(size=(COUNT, 4)), size + shape * rng.normal(size=(COUNT, 3))
    return gaussians_of(
        means, quats, scales, rng.normal(0, 4, COUNT), rng.normal(0, 2, (COUNT, 1, 3))
    )


def view(seed: int, focal: float) -> Camera:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    viewmat = np.eye(4)
    viewmat[:3, :3] = q * np.linalg.det(q)
    K = np.array([[focal, 0, 0.3 * WIDTH], [0, 1.2 * focal, 0.6 * HEIGHT], [0, 0, 1]])
    return Camera(*(jnp.asarray(a, jnp.float32) for a in (viewmat, K)), WIDTH, HEIGHT)


@functools.partial(jax.jit, static_argnames="cfg")
def seen_and_listed(gaussians, alive, camera, cfg):
    splats = project(gaussians, alive, camera, cfg)
    tiles = bin_tiles(splats, camera.width, camera.height, CAPACITY, cfg)
    ids = jnp.where(jnp.arange(CAPACITY) < tiles.offsets[-1], tiles.gaussian_ids, COUNT)
    listed = jnp.zeros(COUNT, bool).at[ids].set(True, mode="drop")
    seen = in_view(gaussians, alive, camera, cfg)
    return seen, listed, required_capacity(gaussians, alive, camera, cfg)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 1000),
    spread=st.sampled_from([0.5, 4.0, 40.0]),
    size=st.floats(-6, 3),
    shape=st.sampled_from([0.0, 0.5, 3.0]),
    near=st.sampled_from([0.05, 0.2, 2.0]),
    focal=st.sampled_from([10.0, 60.0, 400.0]),
)
def test_every_listed_gaussian_is_in_view_and_counted(seed, spread, size, shape, near, focal):
    cfg = RenderConfig(sh_degree=0)
    gaussians, camera = scene(seed, spread, size, shape, near), view(seed, focal)
    alive = jnp.arange(COUNT) % 7 != 3
    seen, listed, need = jax.tree.map(np.asarray, seen_and_listed(gaussians, alive, camera, cfg))
    assert not (listed & ~seen).any()
    assert not seen[~np.asarray(alive)].any()
    host, at = jax.tree.map(np.asarray, (gaussians, camera))
    entries, visible = count_view(host, np.asarray(alive), at, cfg)
    # Both are bounds up to rounding at the edges of tiles and of the image.
    assert entries >= need - 2
    assert visible >= listed.sum()
    assert abs(visible - seen.sum()) <= 2


@pytest.mark.parametrize("room", [1, 50, 400])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_compact_lists_the_flags(room, share):
    flags = np.random.default_rng(0).random(COUNT) < share
    ids, count = jax.jit(compact, static_argnums=1)(jnp.asarray(flags), room)
    expected = np.flatnonzero(flags)
    assert int(count) == len(expected)
    padded = np.full(max(room, len(expected)), COUNT)
    padded[: len(expected)] = expected
    np.testing.assert_array_equal(ids, padded[:room])


def test_buckets_are_few_and_large_enough():
    lengths = {bucket(n) for n in range(1, 200_000, 37)}
    assert len(lengths) < 20
    assert min(lengths) == SMALLEST
    for needed in (1, SMALLEST, SMALLEST + 1, 123_456):
        assert needed * 1.5 <= bucket(needed, 1.5) <= max(SMALLEST, 1.26 * 1.5 * needed)


def test_a_view_is_drawn_again_until_its_lists_fit():
    needs, drawn = iter([40_000, 90_000, 60_000]), []

    def draw(entries):
        drawn.append(entries)
        needed = np.int32(next(needs))
        return f"{entries}", needed, needed > entries

    result, found = until_it_fits(draw, SMALLEST)
    assert drawn == [SMALLEST, bucket(40_000, 1.1), bucket(90_000, 1.1)]
    assert result == f"{found}" == f"{drawn[-1]}"
