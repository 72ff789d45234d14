"""Linear radiance behind the splats, against the float64 oracle."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scenes import street

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import render_linear

BEHIND = (0.5, 2.0, 7.0)
BLACK = RenderConfig(pixels_in_flight=2048)
CFG = dataclasses.replace(BLACK, background=BEHIND)
CAPACITY = 40_000


def brightness(g, cam, cfg):
    alive = jnp.ones(g.capacity, bool)
    result = render_linear(g, alive, cam, cfg, CAPACITY, with_depth=False)
    return jnp.sum(jnp.log1p(result.linear)), result


def test_light_behind_shows_through_and_moves_opacities():
    measure = jax.jit(jax.value_and_grad(brightness, has_aux=True), static_argnames="cfg")
    with jax.enable_x64(True):
        given = street(60, dtype=np.float64)
        exact = dataclasses.replace(CFG, implementation="reference")
        (_, truth), slope = measure(*given, cfg=exact)
        (_, dark), _ = measure(*given, cfg=dataclasses.replace(exact, background=None))
        through = (1 - truth.alpha)[..., None] * np.array(BEHIND)
        np.testing.assert_allclose(truth.linear, dark.linear + through, rtol=1e-12)
        assert 0.1 < float(truth.alpha.mean()) < 0.9
        truth, slope = jax.tree.map(np.asarray, (truth.linear, slope))
    (_, found), gradient = measure(*street(60), cfg=CFG)
    np.testing.assert_allclose(found.linear, truth, rtol=2e-3, atol=2e-3)
    for name in ("means", "opacity_logits", "sh"):
        a, b = getattr(gradient, name), getattr(slope, name)
        assert np.abs(a - b).max() < 2e-3 * np.abs(b).max(), name


def test_where_nothing_is_there_is_nothing_but_it():
    g, cam = street(60)
    none = jax.tree.map(lambda leaf: leaf[:0], g)
    _, result = brightness(none, cam, CFG)
    np.testing.assert_array_equal(result.linear, np.broadcast_to(BEHIND, result.linear.shape))
    _, result = brightness(dataclasses.replace(g, means=-g.means), cam, CFG)
    np.testing.assert_allclose(result.linear, np.broadcast_to(BEHIND, result.linear.shape))
