"""White balance is learned like exposures if it varies per view, and only then."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from splats import gaussians_of
from tiny_scene import make_scene

from p2gs_jax import FitConfig, Params, Photometry, load_run, with_fields
from p2gs_jax.photometry.formation import corner, squared_radii
from p2gs_jax.photometry.response import KNOTS
from p2gs_jax.run.decisions import Decisions, decide, likely, unsolved
from p2gs_jax.train.optimizer import learning_rates
from p2gs_jax.train.update import _recentered

GAUSSIANS = gaussians_of(np.zeros((4, 3)), 1.0, 0.0, 0.0, np.zeros((1, 3)))


def params(balance):
    return Params(GAUSSIANS, Photometry(jnp.zeros(2), jnp.zeros(2), "log", balance))


@pytest.mark.parametrize("level", ["view", "camera"])
@pytest.mark.parametrize("start", ["tracks", "random"])
def test_only_white_balance_per_view_has_the_rate_of_learned_exposures(level, start):
    cfg = with_fields(FitConfig(), {"photometry.white_balance": level, "photometry.start": start})
    like = params(jnp.zeros((2, 3)))
    found = learning_rates(jnp.float32(0.3), jnp.float32(1), 1.0, like, cfg, 1).photometry
    assert (float(found.raw_exposures) > 0) == (start == "random")
    moves = level == "view" and start == "random"
    expected = float(found.raw_exposures) if moves else 0.0
    assert float(found.raw_white_balance) == expected
    assert (expected > 0) == moves
    plain = learning_rates(jnp.float32(0.3), jnp.float32(1), 1.0, params(None), FitConfig(), 1)
    assert plain.photometry.raw_white_balance is None


def test_the_mean_white_balance_of_every_channel_stays_0():
    raw = np.random.default_rng(0).normal(0.3, 0.2, (5, 3)).astype(np.float32)
    photometry = Photometry(jnp.ones(5), jnp.zeros(5), "log", jnp.asarray(raw))
    assert _recentered(photometry, FitConfig()) is photometry  # solved
    for weight in (0.01, None):
        fields = {"photometry.start": "random", "loss.regularizers.log_exposure_mean": weight}
        cfg = with_fields(FitConfig(), fields)
        found = _recentered(photometry, cfg)
        np.testing.assert_allclose(np.mean(found.raw_white_balance, 0), 0, atol=1e-6)
        assert (float(jnp.mean(found.raw_exposures)) == 0) == (weight is not None)


def test_without_solved_exposures_only_white_balance_per_view_remains():
    fields = {"photometry.select": False, "photometry.start": "random"}
    fields |= {"photometry.white_balance": "view", "photometry.vignetting": "camera"}
    cfg = with_fields(FitConfig(), fields)
    decided = decide(cfg, None, None)
    assert (decided.white_balance, decided.vignetting) == ("view", None)
    assert likely(cfg, None, {}) == decided
    by_camera = with_fields(cfg, {"photometry.white_balance": "camera"})
    assert unsolved(Decisions.as_given(by_camera)).white_balance is None
    # Without a solution the spline of `ppisp_solved` has no values.
    splined = with_fields(cfg, {"photometry.curve": "spline"})
    assert unsolved(Decisions.as_given(splined)).curve == "srgb"
    values = with_fields(splined, {"photometry.spline": (0.0,) * len(KNOTS)})
    assert unsolved(Decisions.as_given(values)).curve == "spline"


def photographed_by_a_camera(root, views=8):
    """Write a scene with vignetting and a white balance per view; return the latter's logarithm."""
    scene = make_scene(root, views=views)
    balance = np.random.default_rng(0).normal(0, 0.2, (views, 3))
    balance -= balance.mean(1, keepdims=True)
    for view in range(views):
        path = str(scene / "images" / f"{view}.png")
        linear = (cv2.imread(path)[..., ::-1] / 255.0) ** 2.2 * np.exp(balance[view])
        linear *= np.exp(-0.5 * squared_radii(*linear.shape[:2]))[..., None]
        encoded = np.rint(255 * np.clip(linear, 0, 1) ** (1 / 2.2))
        cv2.imwrite(path, encoded.astype(np.uint8)[..., ::-1])
    return balance


@pytest.mark.slow
def test_a_fit_finds_white_balance_and_vignetting(tmp_path, run_command):
    true = photographed_by_a_camera(tmp_path / "scene")
    argv = [
        *("fit", tmp_path / "scene", "--out", tmp_path / "run", "--steps", 60, "--test-every", 4),
        *("--densify.max-gaussians", 400, "--render.sh-degree", 1, "--init.shell", "off"),
        *("--train.coarse-to-fine", "--photometry.no-select", "--photometry.curve", "power"),
        *("--photometry.white-balance", "view", "--photometry.vignetting", "camera"),
    ]
    assert run_command(*argv)[0] == 0
    run = load_run(tmp_path / "run")
    rows = list(run.scene.train_indices)
    found = np.asarray(run.params.photometry.white_balance)
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-5)
    assert np.abs(found - (true[rows] - true[rows].mean(0))).max() < 0.02
    (camera,) = run.cfg.photometry.cameras
    assert corner(camera)[0] == pytest.approx(np.exp(-0.5), abs=0.05)
