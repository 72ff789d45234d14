"""Display colours: exact where they can be, refined where they cannot, measured everywhere."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from splats import SRGB, camera, haze, random_splats

from p2gs_jax.config import PhotometryConfig, RenderConfig
from p2gs_jax.gaussians import bake
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.harmonics import C0, basis

CFG = RenderConfig(sh_degree=1)


def tone(x):
    return np.clip(x, 0, 1) ** (1 / 2.2)


def test_colours_are_exact_for_degree_0_and_close_for_3():
    sh = np.asarray(random_splats(degree=0).sh)
    shown = bake.display_sh(sh, tone, "exp")
    np.testing.assert_allclose(C0 * shown[:, 0] + 0.5, tone(np.exp(C0 * sh[:, 0])), atol=1e-5)
    clamped = C0 * bake.display_sh(sh, lambda x: 9 * x - 1, "linear")[:, 0] + 0.5
    assert -1e-6 < clamped.min() < clamped.max() < 1 + 1e-6
    mild = np.asarray(random_splats(degree=3).sh) * 0.1
    mild[:, 0] -= 3
    shown = bake.display_sh(mild, tone, "exp")
    d = np.array([0.36, 0.48, 0.8])
    table = np.array([float(b[0]) for b in basis(tuple(jnp.asarray(d[:, None], jnp.float32)), 3)])
    expected = tone(np.exp(np.einsum("k,nkc->nc", table, mild)))
    assert np.abs(np.einsum("k,nkc->nc", table, shown) + 0.5 - expected).max() < 0.03


def test_corrections_by_position_in_the_image_are_left_out():
    grid = DisplayTransform(
        1.0, 2.2, PhotometryConfig(appearance="bilateral"), jnp.ones((12, 8, 16, 16))
    )
    assert grid.without_place().correction is None
    matrix = DisplayTransform(
        1.0, 2.2, PhotometryConfig(appearance="affine"), jnp.full((3, 4), 0.1)
    )
    assert matrix.without_place() is matrix
    g = random_splats(degree=0)
    shown = bake.bake(g, matrix, "exp").sh
    plain = develop(np.exp(C0 * np.asarray(g.sh[:, 0])), replace(matrix, correction=None))
    np.testing.assert_allclose(
        C0 * shown[:, 0] + 0.5,
        np.clip(plain + 0.1 * plain.sum(1, keepdims=True) + 0.1, 0, 1),
        atol=1e-5,
    )


@pytest.fixture(scope="module")
def targets():
    render = make_renderer(CFG)
    views = {f"{x:+.1f}": camera(x) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)}
    return [bake.target(name, haze(), c, render, SRGB) for name, c in views.items()]


def test_the_true_picture_is_composited_in_light_and_then_developed(targets):
    linear = make_renderer(CFG)(haze(), jnp.ones(120, bool), camera(0.0)).linear
    expected = np.rint(255 * develop(linear, SRGB))
    np.testing.assert_array_equal(targets[2].picture, expected)
    assert 20 < expected.mean() < 235


@pytest.mark.slow
def test_refining_brings_viewers_closer_to_unseen_views_as_well(targets):
    """Also over white; a Gaussian that no view shows stays as it is."""
    seen, unseen = [targets[i] for i in (0, 2, 4)], [targets[i] for i in (1, 3)]
    plain = bake.bake(haze(), SRGB, "exp")
    plain = replace(plain, means=plain.means.at[0, 2].set(-3.0))
    refined = bake.refine(plain, seen, CFG, steps=60)
    assert bake.baking_error(plain, [], CFG) is None
    for views in (seen, unseen):
        before, after = (bake.baking_error(g, views, CFG) for g in (plain, refined))
        errors = {name: view["psnr"] for name, view in before["per_view"].items()}
        assert before["worst_view"] == min(errors, key=errors.get)
        assert before["views"] == len(errors) == len(views)
        assert after["psnr_worst"] > before["psnr_worst"] + 3
        assert after["mean_codes"] < before["mean_codes"]
        assert after["psnr_on_white_median"] > before["psnr_on_white_median"]
    base = 0.5 + C0 * np.asarray(refined.sh[:, 0])
    assert base.min() >= -1e-6
    assert base.max() <= 1 + 1e-6
    for name in ("means", "quats", "log_scales"):
        np.testing.assert_array_equal(getattr(refined, name), getattr(plain, name))
    np.testing.assert_array_equal(refined.sh[0], plain.sh[0])
    assert refined.opacity_logits[0] == plain.opacity_logits[0]
    assert np.abs(np.asarray(refined.opacity_logits - plain.opacity_logits)).max() > 0.1


@pytest.mark.slow
def test_a_wall_that_is_dark_by_transparency_becomes_opaque():
    """A translucent black wall looks opaque over black, and not over white."""
    wall, logits = haze(), jnp.full(120, -100.0, jnp.float32).at[-1].set(0.0)
    wall = replace(wall, opacity_logits=logits, sh=wall.sh - 60.0)
    target = bake.target("wall", wall, camera(), make_renderer(CFG), SRGB)
    assert target.picture.max() == 0
    plain = bake.bake(wall, SRGB, "exp")
    assert bake.refine(plain, [target], CFG, steps=0) is plain
    assert bake.refine(plain, [], CFG, steps=9) is plain
    refined = bake.refine(plain, [target], CFG, steps=40)
    before, after = (bake.baking_error(g, [target], CFG) for g in (plain, refined))
    assert before["psnr_worst"] > 60
    assert after["psnr_worst"] > 35
    assert before["psnr_on_white_median"] < 8
    assert after["psnr_on_white_median"] > before["psnr_on_white_median"] + 8


def test_a_known_difference_has_its_known_error():
    nothing = replace(bake.bake(haze(), SRGB, "exp"), opacity_logits=jnp.full(120, -100.0))
    picture = np.full((32, 40, 3), 51, np.uint8)
    target = bake.Target("grey", camera(), picture)
    error = bake.baking_error(nothing, [target], CFG)["per_view"]["grey"]
    assert error["psnr"] == pytest.approx(20 * np.log10(5))
    assert error["mean_codes"] == error["max_codes"] == 51
    assert error["psnr_on_white"] == pytest.approx(20 * np.log10(5 / 4))


@pytest.mark.slow
def test_lifted_colours_look_in_linear_light_as_in_a_viewer():
    """Translucent Gaussians differ; refining brings them closer, in unseen views as well."""
    shown, render = bake.bake(haze(), SRGB, "exp"), make_renderer(bake.viewer_config(CFG))
    places = {f"{x:+.1f}": camera(x) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)}
    views = [bake.target(name, shown, c, render) for name, c in places.items()]
    plain = bake.lift(shown, SRGB)
    refined = bake.refine(plain, views[::2], CFG, steps=60, shown=SRGB)
    for part in (views[::2], views[1::2]):
        before, after = (bake.baking_error(g, part, CFG, SRGB) for g in (plain, refined))
        assert after["psnr_worst"] > before["psnr_worst"] + 3
        assert after["mean_codes"] < before["mean_codes"]
