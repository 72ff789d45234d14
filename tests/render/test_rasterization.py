"""`rasterization` with gsplat's arguments agrees with `render_linear`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import camera, street

import p2gs_jax
from p2gs_jax.config import RenderConfig
from p2gs_jax.render import render_linear
from p2gs_jax.render.harmonics import C0
from p2gs_jax.render.project import view_radiance

CFG = RenderConfig(pixels_in_flight=2048, near=0.01)
WIDTH, HEIGHT = 48, 36
BACK = np.array([[1.0, 0.5, 0.0], [2.0, 2.0, 2.0]], np.float32)


def arguments():
    """Return gsplat's arguments for a street in two cameras."""
    g, cam = street(n=300, width=WIDTH, height=HEIGHT, degree=0)
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[1, 0, 3] = 0.3
    args = {"means": g.means, "quats": g.quats, "scales": jnp.exp(g.log_scales)}
    args |= {"opacities": jax.nn.sigmoid(g.opacity_logits), "Ks": jnp.tile(cam.K, (2, 1, 1))}
    colors = np.exp(np.random.default_rng(4).normal(-1, 1, (300, 3)))
    return args | {k: jnp.float32(v) for k, v in {"colors": colors, "viewmats": viewmats}.items()}


def draw(args, **options):
    options = {"width": WIDTH, "height": HEIGHT, "cfg": CFG} | options
    return p2gs_jax.rasterization(**args, **options)


def ours(args, k, sh):
    """Return `render_linear` of one camera, with the same radiance."""
    g, _ = street(n=len(args["means"]), width=WIDTH, height=HEIGHT, degree=0)
    g = dataclasses.replace(g, sh=sh)
    view = camera(WIDTH, HEIGHT, float(args["Ks"][k, 0, 0]), args["viewmats"][k])
    cfg = dataclasses.replace(CFG, radiance="linear")
    render = jax.jit(render_linear, static_argnames=("cfg", "capacity"))
    return render(g, jnp.ones(g.capacity, bool), view, cfg=cfg, capacity=2**14)


@pytest.fixture(scope="module")
def drawn():
    """Return arguments of two cameras, and their colours with depth, alphas and meta."""
    args = arguments()
    return args, *draw(args, render_mode="RGB+D")


def test_two_cameras_agree_with_render_linear(drawn):
    args, colors, alphas, meta = drawn
    assert colors.shape == (2, HEIGHT, WIDTH, 4)
    assert alphas.shape == (2, HEIGHT, WIDTH, 1)
    assert meta["radii"].shape == meta["means2d"].shape == (2, 300, 2)
    assert not meta["overflow"].any()
    assert (meta["entries"] <= meta["capacity"]).all()
    sh = ((args["colors"] - 0.5) / C0)[:, None]
    for k in range(2):
        r = ours(args, k, sh)
        np.testing.assert_allclose(colors[k, ..., :3], r.linear, atol=1e-5)
        np.testing.assert_allclose(alphas[k, ..., 0], r.alpha, atol=1e-5)
        np.testing.assert_allclose(colors[k, ..., 3], r.depth, atol=1e-3)
        assert r.visible[meta["radii"][k].max(-1) > 0].all()


def test_modes_backgrounds_and_colours_of_each_camera(drawn):
    args, both, alphas, meta = drawn
    fixed = {"capacity": meta["capacity"]}
    rgb, depth = both[..., :3], both[..., 3:]
    expected, _, _ = draw(args, render_mode="RGB+ED", **fixed)
    np.testing.assert_allclose(expected[..., 3:] * jnp.maximum(alphas, 1e-10), depth, rtol=1e-5)
    np.testing.assert_array_equal(draw(args, render_mode="D", **fixed)[0], depth)
    over = dataclasses.replace(CFG, background=(1.0, 0.5, 0.0), near=9.0, blur=9.0)
    explicit = {"cfg": over, "near_plane": CFG.near, "eps2d": CFG.blur} | fixed
    np.testing.assert_allclose(draw(args, **explicit)[0], rgb + (1 - alphas) * BACK[0], 1e-5)
    black = draw(args, backgrounds=jnp.zeros((2, 3)), **explicit)[0]
    np.testing.assert_allclose(black, rgb, 1e-5)
    each = {"colors": jnp.stack([args["colors"], 2 * args["colors"]])}
    twice, _, _ = draw(args | each, backgrounds=jnp.asarray(BACK), render_mode="RGB+D", **fixed)
    behind = (1 - alphas) * BACK[:, None, None]
    # The stop rule depends on the brightest Gaussian.
    np.testing.assert_allclose(
        twice[..., :3], rgb * np.array([1, 2])[:, None, None, None] + behind, atol=2e-3
    )


def test_coefficients_above_the_degree_are_ignored_and_radiance_is_clipped_at_0(drawn):
    args, _, _, meta = drawn
    sh = np.random.default_rng(1).normal(0, 1.0, (300, 9, 3)).astype(np.float32)
    fixed = {"capacity": meta["capacity"], "render_mode": "RGB+D"}
    colors, _, _ = draw(args | {"colors": jnp.asarray(sh)}, sh_degree=1, **fixed)
    assert colors[..., :3].min() >= 0
    g, _ = street(n=300, width=WIDTH, height=HEIGHT, degree=0)
    g = dataclasses.replace(g, sh=jnp.asarray(sh[:, :4]))
    cfg = dataclasses.replace(CFG, radiance="linear")
    radiance = jax.jit(view_radiance, static_argnums=2)
    seen = [radiance(g, camera(viewmat=m), cfg) for m in args["viewmats"]]
    expected, _, _ = draw(args | {"colors": jnp.stack(seen)}, **fixed)
    np.testing.assert_allclose(colors, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "options", "words"),
    [
        ({}, {"render_mode": "RGBD"}, "choose RGB, D, ED"),
        ({"colors": jnp.zeros((300, 4))}, {}, "(300, 3) is needed"),
        ({"scales": jnp.ones((299, 3))}, {}, "scales have shape (299, 3): (300, 3) is needed"),
        ({"opacities": jnp.ones((300, 1))}, {}, "opacities have shape (300, 1): (300,) is needed"),
        ({"Ks": jnp.eye(3)}, {}, "3, 3) is needed"),
        ({}, {"backgrounds": jnp.zeros(3)}, "3) is needed"),
        ({"colors": jnp.zeros((300, 4, 3))}, {"sh_degree": 2}, "(300, 9, 3) is needed"),
    ],
)
def test_invalid_modes_and_shapes_are_refused(changes, options, words):
    with pytest.raises(ValueError, match=words.replace("(", r"\(").replace(")", r"\)")):
        draw(arguments() | changes, **options)


def test_a_capacity_is_required_inside_jit():
    with pytest.raises(ValueError, match="pass capacity="):
        jax.jit(lambda args: draw(args)[0])(arguments())
