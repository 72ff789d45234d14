"""Projection and tile lists inside other JAX programs: vmap, loops, several views, constants."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import street
from p2gs_jax.config import RenderConfig
from p2gs_jax.render import bin_tiles, project
from p2gs_jax.render.xla_cpu import SMALL_CALL

CFG = RenderConfig(pixels_in_flight=2048, binning="counting")
SCENE = street(2000, 64, 48, radius=3.0)
ALIVE = jnp.ones(2000, bool)
VIEWS = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
VIEWS[:, 0, 3] = [0.0, 0.2]
# The capacity is large: XLA compiles small constants and small loops differently.
CAPACITY = 300_000


def binned(gaussians, viewmat):
    """Return splats, and tile entries (-1: empty) from loops that are compiled as functions."""
    splats = project(gaussians, ALIVE, dataclasses.replace(SCENE.camera, viewmat=viewmat), CFG)
    tiles = bin_tiles(splats, 64, 48, CAPACITY, CFG)
    return splats, jnp.where(jnp.arange(CAPACITY) < tiles.offsets[-1], tiles.gaussian_ids, -1)


def listed(gaussians, viewmat):
    return binned(gaussians, viewmat)[1]


@pytest.fixture(scope="module")
def one_by_one():
    single = jax.jit(listed)
    return [single(SCENE.gaussians, m) for m in VIEWS]


@pytest.mark.parametrize(
    "together",
    [
        lambda g, views: jax.vmap(listed, (None, 0))(g, views),
        lambda g, views: [listed(g, m) for m in views],
        lambda g, views: [listed(SCENE.gaussians, jnp.asarray(m)) for m in VIEWS],
    ],
    ids=["vmap", "several views", "constants only"],
)
def test_views_in_one_program_have_the_tile_lists_of_single_views(one_by_one, together):
    np.testing.assert_array_equal(jax.jit(together)(SCENE.gaussians, VIEWS), one_by_one)


def test_the_gradient_of_a_loop_is_the_sum_of_the_gradients_of_views():
    def energy(g, viewmat):
        splats, ids = binned(g, viewmat)
        return jnp.mean(jnp.where(ids[:, None] < 0, 0, splats.means2d[ids] ** 2))

    def looped(g):
        return jnp.sum(jax.lax.map(lambda m: energy(g, m), jnp.asarray(VIEWS)))

    together = jax.jit(jax.grad(looped))(SCENE.gaussians)
    single = jax.jit(jax.grad(energy))
    each = [single(SCENE.gaussians, m) for m in VIEWS]
    summed = jax.tree.map(lambda *views: sum(views), *each)
    for x, y in zip(jax.tree.leaves(together), jax.tree.leaves(summed), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-4 * float(jnp.abs(y).max()))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="an attribute of XLA's CPU backend")
def test_each_loop_is_one_function():
    """Without the attribute these loops would take about ten times as long, without an error."""
    text = jax.jit(listed).lower(SCENE.gaussians, VIEWS[0]).compile().as_text()
    assert len([line for line in text.splitlines() if " call(" in line and SMALL_CALL in line]) >= 4
