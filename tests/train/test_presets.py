"""The paper's presets and the baselines: their fits run, learn, stay finite and load again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_scene import make_scene

import p2gs_jax
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.photometry.appearance import identity
from p2gs_jax.render.visible import BLOCK
from p2gs_jax.train.optimizer import appearance_rate

SMALL = {"render.sh_degree": 1, "train.steps": 40, "train.coarse_to_fine": ()}
SMALL |= {"densify.min_every_steps": 10, "densify.max_gaussians": 400}


def small(name, **densify):
    changed = {f"densify.{field}": value for field, value in densify.items()}
    return with_fields(p2gs_jax.preset(name), SMALL | changed)


def check(result, run):
    log = read_jsonl(run / "log.jsonl")
    assert log[-1]["loss"] < log[0]["loss"]
    assert np.all(np.isfinite(np.asarray(result.params.photometry.exposures)))
    for name in ("summary.png", "splats.ply", "metrics.json", "photometry.json", "config.json"):
        assert (run / name).is_file(), name
    return log


@pytest.mark.slow
def test_the_paper_runs_as_printed(tmp_path):
    cfg = small("paper", grad_threshold=0.0, min_every_steps=4, max_gaussians=None)
    cfg = with_fields(cfg, {"train.steps": 60, "train.log_every": 5})
    result = p2gs_jax.fit(make_scene(tmp_path / "scene"), tmp_path / "run", cfg)
    log = check(result, tmp_path / "run")
    assert {"l1", "dssim", "relative_exposure", "exposure_variance"} <= set(log[0]["terms"])
    # Every view shows all Gaussians, so their growth beyond one block needs larger programs.
    assert log[0]["gaussians"] < BLOCK < log[-1]["gaussians"]


def test_the_appendix_differs_from_the_main_text_in_one_weight():
    cfg = p2gs_jax.preset("paper_appendix")
    assert cfg.loss.relative_exposure.weight == 0.1
    other = with_fields(cfg, {"loss.relative_exposure.weight": 0.01, "preset": "paper"})
    assert other == p2gs_jax.preset("paper")


@pytest.mark.slow
def test_the_loss_rises_after_an_opacity_reset_and_falls_again(tmp_path):
    cfg = small("paper", reset_every=0.4, min_reset_steps=10, prune_scale=10.0)
    cfg = with_fields(cfg, {"train.steps": 160})
    result = p2gs_jax.fit(make_scene(tmp_path / "scene"), tmp_path / "run", cfg)
    assert max(np.diff([r["loss"] for r in check(result, tmp_path / "run")])) > 0.01  # the reset


# Factor on the learning rate by step of 30,000 (arXiv 2601.18336, C.1).
RATES = {0: 0.01, 250: 0.505, 500: 1.0, 15_500: 0.1, 30_000: 0.01 ** (1 - 1 / 60)}
BASELINES = (
    *("3dgs_published", "3dgs_gain", "3dgs_affine", "3dgs_bilateral", "3dgs_curve"),
    *("luminance_gs", "ppisp"),
)


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
def test_baselines_run_and_load_as_they_were_saved(tmp_path, name):
    result = p2gs_jax.fit(make_scene(tmp_path / "scene"), tmp_path / "run", small(name))
    check(result, tmp_path / "run")
    again = p2gs_jax.load_run(tmp_path / "run").params
    saved = result.params.appearance
    exposures = np.asarray(again.photometry.exposures)
    np.testing.assert_allclose(exposures, result.params.photometry.exposures, rtol=1e-5)
    if name in ("3dgs_published", "3dgs_gain"):
        assert saved is None
        assert again.appearance is None
        assert (np.ptp(exposures) > 1e-3) == (name == "3dgs_gain")
    else:
        assert jax.tree.structure(again.appearance) == jax.tree.structure(saved)
        kind = "luminance" if name == "luminance_gs" else name.removeprefix("3dgs_")
        start = identity(kind, ["1"] * len(exposures))
        jax.tree.map(np.testing.assert_array_equal, again.appearance, saved)
        moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), saved, start)
        if name == "ppisp":
            # A run stores PPISP's exposures in `photometry`, like those of all methods.
            assert moved.exposures == 0
            assert np.ptp(exposures) > 1e-3
            moved = (moved.colors, moved.responses, moved.vignettings)
        assert min(jax.tree.leaves(moved)) > 1e-3


def test_the_rate_of_a_learned_camera_warms_up_and_decays_as_published():
    cfg = p2gs_jax.preset("ppisp")
    o = cfg.optimizer
    at = {step: float(appearance_rate(jnp.float32(step / 30_000), cfg)) for step in RATES}
    expected = {step: o.appearance * factor for step, factor in RATES.items()}
    assert at == pytest.approx(expected, rel=1e-4)
    affine = p2gs_jax.preset("3dgs_affine")
    assert float(appearance_rate(jnp.float32(0.0), affine)) == pytest.approx(1e-2)
