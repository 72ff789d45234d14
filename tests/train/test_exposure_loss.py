"""Both readings of the relative-exposure loss under white balance, vignetting and responses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax import FitConfig, Photometry
from p2gs_jax.config import CameraFormation, LossConfig, PhotometryConfig, RelativeExposureConfig
from p2gs_jax.photometry import formation as forming
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import KNOTS
from p2gs_jax.train import exposure_loss as rel
from p2gs_jax.train.exposure_loss import color_pairs

WIDTH, HEIGHT = 48, 32
# Jitted: eager calls would compile every operation.
formation = jax.jit(forming.formation, static_argnames="cfg")
observed_ldr = jax.jit(rel.observed_ldr, static_argnums=(2, 3))
OBSERVED = LossConfig(relative_exposure=RelativeExposureConfig(1.0, "observed_ldr"))
CAMERAS = (
    CameraFormation("a", ((-0.5, 0.1, 0.0),), (tuple(0.2 * np.sin(4 * KNOTS)),)),
    CameraFormation("b", ((-0.2, -0.3, 0.0),), (tuple(0.2 * np.cos(4 * KNOTS)),)),
)
SHADED = PhotometryConfig(cameras=CAMERAS)
CURVED = dataclasses.replace(SHADED, curve="spline")
CONFIGS = pytest.mark.parametrize("cfg", [SHADED, CURVED], ids=["srgb", "spline"])


def truth(views=4, seed=0) -> Photometry:
    rng = np.random.default_rng(seed)
    raw = (rng.normal(0, 0.4, views), rng.normal(0, 0.05, views))
    balance = jnp.asarray(rng.normal(0, 0.25, (views, 3)), jnp.float32)
    exposures, gammas = (jnp.asarray(a, jnp.float32) for a in raw)
    return Photometry(exposures, gammas, "log", balance, tuple(i % 2 for i in range(views)))


def observed(photometry, cfg, count=400) -> rel.ColorPairs:
    rng = np.random.default_rng(1)
    radiance = jnp.asarray(np.exp2(rng.uniform(-5, -2, (count, 3))), jnp.float32)
    rows = rng.integers(0, 4, (2, count)).astype(np.int32)
    at = [jnp.asarray(rng.uniform(-0.6, 0.6, (count, 2)), jnp.float32) for _ in rows]
    colors = [
        formation(radiance, photometry.capture(jnp.asarray(r)), cfg=cfg, positions=p)
        for r, p in zip(rows, at, strict=True)
    ]
    return rel.ColorPairs(*colors, *map(jnp.asarray, rows), *at)


@CONFIGS
def test_the_loss_is_zero_only_at_the_true_photometry(cfg):
    right = truth()
    pairs = observed(right, cfg)
    at_truth = float(observed_ldr(pairs, right, OBSERVED, cfg))
    assert at_truth < 2e-4
    flat = tuple(dataclasses.replace(camera, vignetting=()) for camera in cfg.cameras)
    wrong = {
        "white balance": (dataclasses.replace(right, raw_white_balance=jnp.zeros((4, 3))), cfg),
        "cameras": (dataclasses.replace(right, cameras=(1, 0, 1, 0)), cfg),
        "vignetting": (right, dataclasses.replace(cfg, cameras=flat)),
    }
    if cfg is CURVED:
        wrong["responses"] = (right, dataclasses.replace(cfg, curve="srgb"))
    for name, (photometry, under) in wrong.items():
        loss = float(observed_ldr(pairs, photometry, OBSERVED, under))
        assert loss > max(2e-3, 20 * at_truth), name


def test_the_literal_reading_includes_white_balance_and_vignetting():
    right = dataclasses.replace(truth(), raw_gammas=jnp.zeros(4))
    linear, views = jnp.full((HEIGHT, WIDTH, 3), 0.2), (jnp.int32(0), jnp.int32(1))
    cfg = LossConfig(relative_exposure=RelativeExposureConfig(1.0))
    literal = jax.jit(rel.relative_exposure_loss, static_argnums=(4, 5))
    found = float(literal(linear, views, None, right, cfg, SHADED))
    uncurved = dataclasses.replace(SHADED, curve="linear", pivot=1.0)
    first, second = (np.asarray(formation(linear, right.capture(i), cfg=uncurved)) for i in views)
    expected = np.abs((second / first - 1) * 0.2).sum(-1).mean()
    assert found == pytest.approx(expected, rel=1e-4)


def test_color_pairs_are_two_views_of_a_point_and_have_positions_under_vignetting():
    count = 60
    rng = np.random.default_rng(0)
    views, points = np.repeat(np.arange(3), 20), np.tile(np.arange(20), 3)
    colors = rng.uniform(0.2, 0.8, (count, 3)).astype(np.float32)
    places = rng.uniform(-0.5, 0.5, (count, 2)).astype(np.float32)
    seen = (views, points, colors, np.zeros_like(colors), 3, 20, np.zeros(3, int))
    observations = Observations(*seen, positions=places)
    cfg = FitConfig(loss=OBSERVED)
    plain = color_pairs(observations, cfg)
    assert plain is not None
    assert plain.positions_i is None
    placed = color_pairs(observations, dataclasses.replace(cfg, photometry=SHADED))
    assert placed is not None
    of_i, of_j = (placed.colors_i, placed.positions_i), (placed.colors_j, placed.positions_j)
    pairs = []
    for colors, positions in (of_i, of_j):
        few = np.asarray(colors)[:count]
        rows = [np.flatnonzero((observations.colors == c).all(1))[0] for c in few]
        np.testing.assert_array_equal(positions[:count], observations.positions[rows])
        pairs.append(np.array(rows))
    assert np.all(points[pairs[0]] == points[pairs[1]])
    assert np.all(views[pairs[0]] != views[pairs[1]])
    unplaced = dataclasses.replace(observations, positions=None)
    with pytest.raises(ValueError, match="positions in the images are not known"):
        color_pairs(unplaced, dataclasses.replace(cfg, photometry=SHADED))
