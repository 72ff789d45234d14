"""PPISP against its formulas in numpy: what each part keeps, and true gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry.appearance import correction_of, exposures_apart
from p2gs_jax.photometry.formation import formation
from p2gs_jax.photometry.ppisp import (
    SOURCES,
    OneView,
    applied,
    falloff,
    homography_of,
    identity,
    identity_response,
    offsets,
    recolored,
    regularisation_of,
    respond,
)
from p2gs_jax.types import Params, Photometry

IMAGE = np.random.default_rng(0).uniform(0.02, 0.9, (12, 20, 3))
IDENTITY = np.tile(identity_response(), (3, 1))


def some_view(seed=1, size=0.3, dtype=np.float32) -> OneView:
    rng = np.random.default_rng(seed)
    vignetting = rng.normal(0, 0.1 * size, (3, 5))
    vignetting[:, 2:] -= 0.3
    return OneView(
        *(
            jnp.asarray(values, dtype)
            for values in (
                rng.normal(0, size) - 0.5,
                rng.normal(0, size, 8),
                IDENTITY + rng.normal(0, size, (3, 4)),
                vignetting,
            )
        )
    )


# ---------------------------------------------------------------- as published, in numpy


def softplus(x):
    return np.log1p(np.exp(x))


def four_point_homography(targets):
    """Solve the direct linear transformation of four pairs by its null space."""
    rows = []
    for (x, y, w), (u, v, _) in zip(SOURCES, targets, strict=True):
        rows.append([x, y, w, 0, 0, 0, -u * x, -u * y, -u * w])
        rows.append([0, 0, 0, x, y, w, -v * x, -v * y, -v * w])
    h = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    return h / h[2, 2]


def oracle(linear, view: OneView):
    height, width, _ = linear.shape
    exposure, color, response, vignetting = (np.asarray(x, float) for x in jax.tree.leaves(view))
    light = linear * 2.0**exposure
    for i in range(height):
        for j in range(width):
            place = (np.array([j, i]) + 0.5 - np.array([width, height]) / 2) / max(width, height)
            for c in range(3):
                r = np.linalg.norm(place - vignetting[c, :2])
                dark = 1 + sum(a * r ** (2 * k + 2) for k, a in enumerate(vignetting[c, 2:]))
                light[i, j, c] *= np.clip(dark, 0, 1)
    targets = SOURCES.copy()
    targets[:, :2] += np.asarray(offsets(jnp.asarray(color)))
    h = four_point_homography(targets)
    intensity = light.sum(-1)
    moved = np.stack([light[..., 0], light[..., 1], intensity], -1) @ h.T
    moved *= (intensity / (moved[..., 2] + 1e-5))[..., None]
    light = np.stack([moved[..., 0], moved[..., 1], moved[..., 2] - moved[..., 0] - moved[..., 1]])
    out = np.empty_like(linear)
    for c in range(3):
        toe, shoulder = 0.3 + softplus(response[c, :2])
        gamma, centre = 0.1 + softplus(response[c, 2]), 1 / (1 + np.exp(-response[c, 3]))
        x = np.clip(light[c], 0, 1)
        a = shoulder * centre / (toe * (1 - centre) + shoulder * centre)
        low = a * (x / centre) ** toe
        high = 1 - (1 - a) * ((1 - x) / (1 - centre)) ** shoulder
        out[..., c] = np.where(x <= centre, low, high) ** gamma
    return out


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_computes_what_the_paper_says(seed):
    view = some_view(seed)
    ours = jax.jit(applied)(jnp.asarray(IMAGE, jnp.float32), view)
    np.testing.assert_allclose(ours, oracle(IMAGE, view), atol=3e-5)


# ------------------------------------------------------------------------------- the parts


def test_the_identity_changes_nothing_within_the_range_of_display_values():
    parameters = identity(["left", "right", "left"])
    assert parameters.names == ("left", "right")
    image = jnp.asarray(IMAGE, jnp.float32)
    for view in (parameters.view(1), parameters.mean("left"), parameters.mean()):
        np.testing.assert_allclose(applied(image, view), image, atol=2e-5)
        np.testing.assert_allclose(applied(image + 2, view), 1.0, atol=1e-6)


def test_a_view_has_its_own_exposure_and_its_cameras_response():
    parameters = identity(["b", "a", "b"])
    parameters = jax.tree.map(
        lambda x: jnp.arange(x.size, dtype=x.dtype).reshape(x.shape), parameters
    )
    view = parameters.view(jnp.int32(2))
    assert float(view.exposure) == 2
    np.testing.assert_array_equal(view.response, parameters.responses[1])
    np.testing.assert_array_equal(view.vignetting, parameters.vignettings[1])
    mean = parameters.mean("a")
    assert float(mean.exposure) == 1
    np.testing.assert_array_equal(mean.color, parameters.colors[1])
    np.testing.assert_array_equal(mean.response, parameters.responses[0])
    assert parameters.mean("unknown").vignetting is None


def test_vignetting_is_measured_from_its_centre_in_units_of_the_longer_side():
    wide = np.zeros((3, 5), np.float32)
    wide[1] = [0.25, -0.1, -0.8, 0, 0]
    dark = np.asarray(falloff(jnp.asarray(wide), 20, 40))
    np.testing.assert_array_equal(dark[..., [0, 2]], 1)
    i, j = np.unravel_index(dark[..., 1].argmax(), (20, 40))
    assert abs(j + 0.5 - (20 + 0.25 * 40)) <= 0.5
    assert abs(i + 0.5 - (10 - 0.1 * 40)) <= 0.5
    r2 = ((0.5 - 30) ** 2 + (0.5 - 6) ** 2) / 40**2
    assert dark[0, 0, 1] == pytest.approx(1 - 0.8 * r2, abs=1e-6)
    # The same part of the lens at another size.
    np.testing.assert_allclose(
        np.asarray(falloff(jnp.asarray(wide), 40, 80)).reshape(20, 2, 40, 2, 3).mean((1, 3)),
        dark,
        atol=1e-3,
    )
    bright = np.zeros((3, 5), np.float32)
    bright[:, 2] = 0.5
    assert np.asarray(falloff(jnp.asarray(bright), 20, 40)).max() == 1


colors = st.lists(st.floats(-2, 2), min_size=8, max_size=8)


@settings(max_examples=30, deadline=None)
@given(st.lists(colors, min_size=3, max_size=3))
def test_homographies_map_the_control_points_and_keep_intensity(parameters):
    latent = jnp.asarray(parameters, jnp.float32)
    h = np.asarray(jax.vmap(homography_of)(latent), float)
    moved = np.einsum("bij,kj->bki", h, SOURCES)
    expected = SOURCES[None, :, :2] + np.asarray(offsets(latent))
    np.testing.assert_allclose(moved[..., :2] / moved[..., 2:], expected, atol=2e-5)
    assert h[:, 2, 2] == pytest.approx(1.0)
    colored = jax.vmap(recolored, in_axes=(None, 0))(jnp.asarray(IMAGE, jnp.float32), latent)
    sums = np.broadcast_to(IMAGE.sum(-1), colored.shape[:-1])
    # EPSILON of an intensity that the projection may have made smaller.
    np.testing.assert_allclose(np.asarray(colored).sum(-1), sums, rtol=1e-3)


raws = st.lists(st.floats(-4, 4), min_size=12, max_size=12)


@settings(max_examples=30, deadline=None)
@given(st.lists(raws, min_size=3, max_size=3))
def test_responses_rise_from_black_to_white(raw):
    with jax.enable_x64(True):
        x = jnp.linspace(0.0, 1.0, 301, dtype=jnp.float64)[:, None] * jnp.ones(3)
        many = jnp.asarray(raw, jnp.float64).reshape(3, 3, 4)
        y = np.asarray(jax.vmap(respond, in_axes=(None, 0))(x, many))
    np.testing.assert_array_equal(y[:, 0], 0)
    np.testing.assert_array_equal(y[:, -1], 1)
    assert np.all(np.diff(y, axis=1) >= -1e-12)
    assert np.all(np.diff(y[:, ::50], axis=1) > 0)


def test_both_parts_of_a_response_meet_with_one_slope():
    with jax.enable_x64(True):
        raw = jnp.asarray(np.tile([1.5, -0.5, 0.3, 0.7], (3, 1)), jnp.float64)
        centre = 1 / (1 + np.exp(-0.7))
        x = jnp.asarray(centre + np.array([-2e-6, -1e-6, 1e-6, 2e-6]), jnp.float64)
        y = np.asarray(respond(x[:, None] * jnp.ones(3), raw))[:, 0]
    assert (y[1] - y[0]) == pytest.approx(y[3] - y[2], rel=1e-4)


def test_gradients_match_finite_differences():
    with jax.enable_x64(True):
        image = jnp.asarray(IMAGE, jnp.float64)
        view = some_view(dtype=np.float64)
        weight = jnp.asarray(np.random.default_rng(3).normal(size=image.shape))

        @jax.jit
        def f(given):
            view, linear = given
            return jnp.sum(weight * applied(linear, view))

        rng = np.random.default_rng(4)
        leaves, tree = jax.tree.flatten((view, image))
        gradient = jax.tree.leaves(jax.jit(jax.grad(f))((view, image)))
        h = 1e-7
        for k, leaf in enumerate(leaves):
            along = jnp.asarray(rng.normal(size=leaf.shape))

            def moved(step, k=k, along=along):
                there = [*leaves[:k], leaves[k] + step * along, *leaves[k + 1 :]]
                return float(f(jax.tree.unflatten(tree, there)))

            numeric = (moved(h) - moved(-h)) / (2 * h)
            exact = float(jnp.sum(gradient[k] * along))
            assert exact == pytest.approx(numeric, rel=1e-4, abs=1e-6)


def test_black_and_saturated_pixels_have_finite_gradients():
    image = jnp.asarray([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [3.0, 0.0, 1e-9]]], jnp.float32)
    view = some_view(2, 1.5)
    gradient = jax.jit(jax.grad(lambda v, x: jnp.sum(applied(x, v)), (0, 1)))(view, image)
    assert all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(gradient))
    # At the identity the clips stand on their bounds; their parameters must be able to leave.
    start = identity(["a"])
    image = jnp.asarray(IMAGE, jnp.float32)
    at_start = jax.jit(jax.grad(lambda p: jnp.sum(applied(image, p.view(0)))))(start)
    y, x = np.mgrid[:12, :20] + 0.5
    r2 = ((y - 6) ** 2 + (x - 10) ** 2) / 20**2
    expected = (IMAGE * r2[..., None]).sum((0, 1))
    np.testing.assert_allclose(at_start.vignettings[0, :, 2], expected, rtol=1e-3)


def test_the_regularisation_is_what_is_published():
    parameters = identity(["a", "a", "b"])
    assert float(regularisation_of(parameters)) == pytest.approx(0, abs=1e-7)
    rng = np.random.default_rng(5)
    parameters = jax.tree.map(
        lambda x: x + jnp.asarray(rng.normal(0, 0.4, x.shape), x.dtype), parameters
    )

    def huber(x, delta):
        x = np.abs(x)
        return np.where(x < delta, x**2 / (2 * delta), x - delta / 2)

    exposures, colors, responses, vignettings = (
        np.asarray(x, float) for x in jax.tree.leaves(parameters)
    )
    moved = np.asarray(offsets(jnp.asarray(colors, jnp.float32)), float).mean(0)
    expected = (
        huber(exposures.mean(), 0.1)
        + huber(moved, 0.005).mean()
        + 0.1 * (vignettings.var(1).mean() + responses.var(1).mean())
        + 0.02 * (vignettings[..., :2] ** 2).sum(-1).mean()
        + 0.01 * np.maximum(vignettings[..., 2:], 0).mean()
    )
    assert float(regularisation_of(parameters)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("parameterization", ["log", "linear"])
def test_exposures_are_handed_on_and_photographs_stay(parameterization):
    learned = identity(["a", "b"])
    learned = replace(learned, exposures=jnp.asarray([0.7, -1.2], jnp.float32))
    one = jnp.zeros(2) if parameterization == "log" else jnp.ones(2)
    gammas = jnp.zeros(2) if parameterization == "log" else jnp.full(2, 2.2)
    photometry = Photometry(one, gammas, parameterization)
    before = Params(None, photometry, learned)  # pyright: ignore[reportArgumentType]
    after = exposures_apart(before)
    np.testing.assert_allclose(after.photometry.exposures, [2**0.7, 2**-1.2], rtol=1e-5)
    cfg = PhotometryConfig(curve="linear", appearance="ppisp")
    for row in range(2):
        pictures = [
            formation(
                jnp.asarray(0.4 * IMAGE, jnp.float32),
                p.photometry.capture(row),
                cfg,
                correction_of(p.appearance, row),
            )
            for p in (before, after)
        ]
        np.testing.assert_allclose(*pictures, atol=1e-5)
        assert float(jnp.abs(pictures[0] - 0.4 * IMAGE).max()) > 0.05
