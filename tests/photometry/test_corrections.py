"""Corrections of display values: identity at the start, published formulas, gradients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from p2gs_jax.config import CameraFormation, LossConfig, PhotometryConfig
from p2gs_jax.evaluation.alignment import fit_exposure
from p2gs_jax.photometry import appearance, ppisp
from p2gs_jax.photometry import luminance as gs
from p2gs_jax.photometry.appearance import GRID, exposures_apart, identity, regularisation
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.formation import formation
from p2gs_jax.photometry.ppisp_start import start_of
from p2gs_jax.train import terms
from p2gs_jax.types import LUMINANCE, Capture, Params, Photometry

RNG = np.random.default_rng(0)
IMAGE = RNG.uniform(0.02, 0.9, (12, 20, 3))
PICTURE = jnp.asarray(IMAGE, jnp.float32)
MASK = jnp.ones(IMAGE.shape[:2], jnp.float32)
# Compiled once per shape; eager calls would compile each operation.
corrected = jax.jit(appearance.corrected, static_argnums=2)
correction_of, contrast_loss = jax.jit(appearance.correction_of), jax.jit(terms.contrast_loss)
mean_correction = jax.jit(appearance.mean_correction, static_argnums=1)
applied, enhanced = jax.jit(ppisp.applied), jax.jit(gs.enhanced)
cumulative = jax.jit(gs.cumulative, static_argnums=2)


def noisy(kind, size=0.1):
    zero = identity(kind, ["a"])[0]
    return jnp.asarray(np.random.default_rng(1).normal(0, size, zero.shape), jnp.float32)


@pytest.mark.parametrize("kind", ["affine", "bilateral", "curve", "ppisp", "luminance"])
def test_the_identity_changes_nothing(kind):
    start = identity(kind, ["left", "right", "left"])
    for one in (correction_of(start, 1), *(mean_correction(start, c) for c in ("left", None))):
        np.testing.assert_allclose(corrected(PICTURE, one, kind), PICTURE, atol=2e-5)
        if kind == "ppisp":
            np.testing.assert_allclose(applied(PICTURE + 2, one), 1.0, atol=1e-6)
        if kind == "luminance":
            np.testing.assert_allclose(enhanced(PICTURE, one), PICTURE, atol=1e-6)
    even = np.linspace(0, 1, gs.ENTRIES)
    np.testing.assert_allclose(jax.jit(gs.pseudo_curve)(jnp.zeros(3)), even, atol=2.1e-3)


def test_a_colour_matrix_is_learned_only_where_photographs_are_not_clipped():
    def total(ldr):
        return corrected(ldr, noisy("affine", 0.05), "affine").sum()

    bright, between, dark = (np.full((1, 1, 3), value) for value in (2.0, 0.5, -1.0))
    assert total(bright) == pytest.approx(3.0)
    assert total(dark) == pytest.approx(0.0)
    slopes = [np.abs(jax.grad(total)(jnp.asarray(x))).max() for x in (bright, between, dark)]
    assert slopes == [0.0, pytest.approx(1.0, abs=0.2), 0.0]


def test_a_bilateral_grid_is_sliced_trilinearly():
    grid = noisy("bilateral")
    height, width, _ = IMAGE.shape
    axes = [np.linspace(0, 1, n) for n in GRID]
    y, x = np.mgrid[:height, :width]
    where = np.stack([IMAGE @ np.array(LUMINANCE), y / (height - 1), x / (width - 1)], -1)
    entries = [RegularGridInterpolator(axes, np.asarray(g))(where) for g in grid]
    matrix = np.stack(entries, -1).reshape(height, width, 3, 4)
    expected = IMAGE + np.einsum("hwij,hwj->hwi", matrix[..., :3], IMAGE) + matrix[..., 3]
    np.testing.assert_allclose(corrected(PICTURE, grid, "bilateral"), expected, atol=1e-5)


def test_a_curve_rises_and_continues_smoothly_above_1():
    x = jnp.linspace(0, 1.5, 400)[:, None, None] * jnp.ones(3)
    y = np.asarray(corrected(x, noisy("curve", 1.0), "curve"))[:, 0, 0]
    assert np.all(np.diff(y) > 0)
    assert y[0] == 0
    assert np.abs(np.diff(y, 2)).max() < 0.05


def test_only_bilateral_grids_are_regularised():
    smooth = jnp.ones_like(identity("bilateral", ["a", "b"]))
    grids = jax.jit(regularisation, static_argnums=1)
    assert float(grids(smooth, "bilateral")) == 0
    assert float(grids(noisy("bilateral")[None], "bilateral")) > 1e-3
    assert regularisation(noisy("affine")[None], "affine") is None


def test_a_correction_is_part_of_the_image_and_of_the_fitted_exposure():
    cfg = PhotometryConfig(curve="linear", appearance="affine")
    correction = noisy("affine", 0.05)
    photo = formation(0.5 * PICTURE, Capture(jnp.float32(1.4), jnp.float32(2.2)), cfg, correction)
    np.testing.assert_allclose(photo, corrected(0.7 * PICTURE, correction, "affine"), atol=1e-6)
    usual = Capture(jnp.float32(1.0), jnp.float32(2.2))
    found = fit_exposure(0.5 * PICTURE, jnp.clip(photo, 0, 1), MASK, usual, cfg, correction)
    assert float(found) == pytest.approx(1.4, rel=0.01)


# ------------------------------------------------------- PPISP, as published, in numpy


def some_view(seed=1, size=0.3) -> ppisp.OneView:
    rng = np.random.default_rng(seed)
    vignetting = rng.normal(0, 0.1 * size, (3, 5)) - [0, 0, 0.3, 0.3, 0.3]
    response = ppisp.identity_response() + rng.normal(0, size, (3, 4))
    values = (rng.normal(0, size) - 0.5, rng.normal(0, size, 8), response, vignetting)
    return ppisp.OneView(*(jnp.asarray(v, jnp.float32) for v in values))


def four_point_homography(targets):
    """Solve the direct linear transformation of four pairs by its null space."""
    rows = []
    for (x, y, w), (u, v, _) in zip(ppisp.SOURCES, targets, strict=True):
        rows.append([x, y, w, 0, 0, 0, -u * x, -u * y, -u * w])
        rows.append([0, 0, 0, x, y, w, -v * x, -v * y, -v * w])
    h = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    return h / h[2, 2]


def oracle(linear, view: ppisp.OneView):
    height, width, _ = linear.shape
    exposure, color, response, vignetting = (np.asarray(x, float) for x in jax.tree.leaves(view))
    light = linear * 2.0**exposure
    for i, j, c in np.ndindex(*linear.shape):
        place = (np.array([j, i]) + 0.5 - np.array([width, height]) / 2) / max(width, height)
        r = np.linalg.norm(place - vignetting[c, :2])
        dark = 1 + sum(a * r ** (2 * k + 2) for k, a in enumerate(vignetting[c, 2:]))
        light[i, j, c] *= np.clip(dark, 0, 1)
    targets = ppisp.SOURCES.copy()
    targets[:, :2] += np.asarray(ppisp.offsets(jnp.asarray(color)))
    intensity = light.sum(-1)
    moved = np.stack([light[..., 0], light[..., 1], intensity], -1)
    moved = moved @ four_point_homography(targets).T
    moved *= (intensity / (moved[..., 2] + 1e-5))[..., None]
    moved[..., 2] -= moved[..., 0] + moved[..., 1]
    out = np.empty_like(linear)
    for c in range(3):
        toe, shoulder = 0.3 + np.log1p(np.exp(response[c, :2]))
        gamma, centre = 0.1 + np.log1p(np.exp(response[c, 2])), 1 / (1 + np.exp(-response[c, 3]))
        x = np.clip(moved[..., c], 0, 1)
        a = shoulder * centre / (toe * (1 - centre) + shoulder * centre)
        low = a * (x / centre) ** toe
        high = 1 - (1 - a) * ((1 - x) / (1 - centre)) ** shoulder
        out[..., c] = np.where(x <= centre, low, high) ** gamma
    return out


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_ppisp_agrees_with_the_published_formulas(seed):
    view = some_view(seed)
    np.testing.assert_allclose(applied(PICTURE, view), oracle(IMAGE, view), atol=3e-5)


def test_exposures_belong_to_views_and_responses_to_cameras():
    start = ppisp.identity(["b", "a", "b"])
    assert start.names == ("a", "b")
    parameters = jax.tree.map(lambda x: jnp.arange(x.size, dtype=x.dtype).reshape(x.shape), start)
    views = (parameters.view(jnp.int32(2)), 1, 2), (parameters.mean("a"), 0, 1)
    for view, row, exposure in views:
        assert float(view.exposure) == exposure
        np.testing.assert_array_equal(view.color, parameters.colors[exposure])
        np.testing.assert_array_equal(view.response, parameters.responses[row])
        np.testing.assert_array_equal(view.vignetting, parameters.vignettings[row])
    assert parameters.mean("unknown").vignetting is None


def test_gradients_of_ppisp_are_finite_at_black_and_white():
    image = jnp.asarray([[[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [3.0, 0.0, 1e-9]]], jnp.float32)
    slope = jax.jit(jax.grad(lambda v, x: jnp.sum(ppisp.applied(x, v)), (0, 1)))
    gradient = slope(some_view(2, 1.5), image)
    assert all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(gradient))
    # At the identity values are at the bounds of clips, where gradients must not vanish.
    at_start = slope(ppisp.identity(["a"]).view(0), PICTURE)[0]
    y, x = np.mgrid[:12, :20] + 0.5
    r2 = ((y - 6) ** 2 + (x - 10) ** 2) / 20**2
    expected = (IMAGE * r2[..., None]).sum((0, 1))
    np.testing.assert_allclose(at_start.vignetting[:, 2], expected, rtol=1e-3)


def test_the_regularisation_follows_the_published_formula():
    published, start = jax.jit(ppisp.regularisation_of), ppisp.identity(["a", "a", "b"])
    assert float(published(start)) == pytest.approx(0, abs=1e-7)
    moved = jax.tree.map(lambda x: x + jnp.asarray(RNG.normal(0, 0.4, x.shape), x.dtype), start)

    def huber(x, delta):
        x = np.abs(x)
        return np.where(x < delta, x**2 / (2 * delta), x - delta / 2)

    exposures, colors, responses, vignettings = (
        np.asarray(x, float) for x in jax.tree.leaves(moved)
    )
    offsets = np.asarray(ppisp.offsets(jnp.asarray(colors, jnp.float32)), float).mean(0)
    expected = (
        huber(exposures.mean(), 0.1)
        + huber(offsets, 0.005).mean()
        + 0.1 * (vignettings.var(1).mean() + responses.var(1).mean())
        + 0.02 * (vignettings[..., :2] ** 2).sum(-1).mean()
        + 0.01 * np.maximum(vignettings[..., 2:], 0).mean()
    )
    assert float(published(moved)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("parameterization", ["log", "linear"])
def test_exposures_move_from_ppisp_to_the_photometry_and_photographs_stay(parameterization):
    start = replace(ppisp.identity(["a", "b"]), exposures=jnp.asarray([0.7, -1.2], jnp.float32))
    raw = (jnp.zeros(2),) * 2 if parameterization == "log" else (jnp.ones(2), jnp.full(2, 2.2))
    photometry = Photometry(*raw, parameterization)
    before = Params(None, photometry, start)  # pyright: ignore[reportArgumentType]
    after = exposures_apart(before)
    np.testing.assert_allclose(after.photometry.exposures, [2**0.7, 2**-1.2], rtol=1e-5)
    cfg, light = PhotometryConfig(curve="linear", appearance="ppisp"), 0.4 * PICTURE
    for row in range(2):
        pictures = [
            formation(light, p.photometry.capture(row), cfg, correction_of(p.appearance, row))
            for p in (before, after)
        ]
        np.testing.assert_allclose(*pictures, atol=1e-5)
        assert float(jnp.abs(pictures[0] - light).max()) > 0.05


# ---------------------------------------------------------------------- Luminance-GS

# Fields that are learned; statistics are not.
LEARNED = ("curve", "hidden", "hidden_bias", "out", "out_bias", "axes")


def learned(size) -> gs.Luminance:
    """Return parameters about the identity, with the statistics of noise."""
    rng = np.random.default_rng(1)
    start = gs.identity(2)
    moved = {n: getattr(start, n) + rng.normal(0, size, getattr(start, n).shape) for n in LEARNED}
    both = replace(start, **moved, statistics=rng.uniform(0, 1, (2, gs.STATISTICS)))
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), both)


@pytest.mark.parametrize("size", [0.3, 3.0, 100.0])
def test_curves_stay_in_bounds_whatever_is_learned(size):
    view = learned(size).view(0)
    assert 0 <= float(view.curve.min()) < float(view.curve.max()) <= 1
    # At large sizes the clip is active.
    assert float(view.curve.min()) == 0 or size < 1
    assert bool(np.isfinite(enhanced(PICTURE, view)).all())


def test_a_rising_curve_is_inverted_and_any_curve_gives_a_rising_display():
    start = gs.identity(1)
    view = replace(start, curve=start.curve**0.4, axes=start.axes + 0.7).view(0)
    photographed = jax.jit(gs.as_photographed)
    np.testing.assert_allclose(photographed(enhanced(PICTURE, view), view), PICTURE, atol=0.03)
    grey = jnp.tile(jnp.linspace(0, 1, 50)[:, None], 3)
    shown = photographed(grey, replace(start, curve=1 - start.curve).view(0))
    assert (np.diff(shown, axis=0) >= -1e-6).all()


def test_histogram_equalisation_follows_the_cumulative_histogram():
    grey = jnp.asarray([0.1, 0.1, 0.5, 0.9])
    found = cumulative(grey, jnp.asarray([1.0, 1.0, 1.0, 0.0]), 11)
    np.testing.assert_allclose(found, [0, *[2 / 3] * 4, *[1] * 6], atol=1e-6)
    np.testing.assert_allclose(cumulative(grey, jnp.zeros(4), 5), [0, 0.25, 0.5, 0.75, 1])
    seen = jax.jit(gs.statistics_of)(PICTURE, MASK)
    np.testing.assert_allclose(seen[-3:], IMAGE[::4, ::4].mean((0, 1)), rtol=1e-5)


def test_the_prior_of_a_dark_photograph_brightens_its_curve():
    start = gs.identity(1)

    @jax.jit
    def prior(curve, power=1.0):
        out_bias = start.out_bias.at[gs.ENTRIES].set((power - 1) / gs.POWER_UNIT)
        moved = replace(start, curve=curve, out_bias=out_bias)
        return terms.curve_prior(moved.view(0), 0.1 * PICTURE, MASK)

    assert float(jax.grad(prior)(start.curve)[10:80].max()) < 0
    # A bent curve costs less only if the pseudo curve bends with it.
    bent = start.curve**0.4
    assert float(prior(bent, 0.4)) < float(prior(start.curve)) < float(prior(bent))


def test_contrast_compares_with_the_brightened_photograph():
    dark = 0.1 * PICTURE
    bright = dark * (0.5 / dark.mean())
    # The loss ignores brightness.
    for same in (bright, bright + 0.2):
        assert float(contrast_loss(same, dark, MASK)) == pytest.approx(0, abs=1e-9)
    assert float(contrast_loss(dark, dark, MASK)) > 1e-3
    half = MASK.at[:, :10].set(0)
    raised = dark * 0.5 / dark[:, 10:].mean()
    aligned = jnp.where(half[..., None] > 0, raised, 9.0 * (jnp.arange(20) < 7)[:, None])
    assert float(contrast_loss(aligned, dark, half)) == pytest.approx(0, abs=1e-9)


def test_shown_renders_train_no_curve_and_nothing_trains_the_statistics():
    at = learned(0.05)

    def shown(parameters):
        return jnp.sum(corrected(PICTURE, parameters.view(0), "luminance"))

    def both(parameters):
        return shown(parameters) + jnp.sum(gs.enhanced(PICTURE, parameters.view(0)))

    of_both, of_shown = (jax.jit(jax.grad(f))(at) for f in (both, shown))
    assert not np.any(of_both.statistics)
    assert np.any(of_both.curve)
    assert not any(np.any(v) for v in jax.tree.leaves(of_shown))


def test_masked_pixels_get_no_gradient():
    mask, view = MASK.at[:4].set(0), learned(0.05).view(0)

    def f(render):
        compared = terms.enhanced_loss(render, PICTURE, mask, view, LossConfig())
        return compared + contrast_loss(render, PICTURE, mask)

    slope = jax.jit(jax.grad(f))(PICTURE * 0.5)
    assert not np.any(slope[:4])
    assert np.any(slope[4:])


# Three photographs.
EXPOSURES, GAMMAS = np.array([0.5, 1.0, 3.0]), np.full(3, 2.2)
BALANCES = np.log([[1.2, 1.0, 1 / 1.2], [1, 1, 1], [0.8, 1.1, 1 / 0.88]])
# The second camera has vignetting per channel; its photographs are in portrait format.
DARKENS = (((-0.3, 0.05, 0.0),), ((-0.4, 0, 0), (-0.5, 0, 0), (-0.6, 0, 0)))
CAMERAS = tuple(CameraFormation(n, v) for n, v in zip("ab", DARKENS, strict=True))
SIZES = {"a": (48, 32), "b": (32, 48)}


@pytest.mark.parametrize(("curve", "codes"), [("power", 0.5), ("srgb", 1.5)])
def test_solved_photometry_in_the_parameters_of_ppisp_gives_our_greys_and_vignetting(curve, codes):
    cfg, cameras = PhotometryConfig(curve=curve, cameras=CAMERAS), ("a", "a", "b")
    start = start_of(cfg, cameras, EXPOSURES, GAMMAS, BALANCES, SIZES)
    assert start.codes.max() < codes
    # PPISP pulls the mean exposure to 0 stops.
    assert float(np.mean(start.parameters.exposures)) == pytest.approx(0, abs=1e-5)
    for row, name in enumerate(cameras):
        width, height = SIZES[name]
        ramp = np.geomspace(1e-3, 2, width * height, dtype=np.float32)
        grey = np.repeat(np.random.default_rng(row).permutation(ramp)[:, None], 3, 1)
        grey = grey.reshape(height, width, 3)
        settings = {"white_balance": tuple(BALANCES[row]), "camera": "ab".index(name)}
        expected = develop(grey, DisplayTransform(EXPOSURES[row], 2.2, cfg, **settings))
        light = grey * np.float32(2**start.radiance_ev)
        found = applied(light, start.parameters.view(row))
        off = 255 * np.abs(np.asarray(found) - expected)
        assert off.max() < codes + 1
        assert off.mean() < 1.5
