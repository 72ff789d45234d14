"""The table of mixtures: the common exposure is the mean of one group, and nothing is invented."""

import dataclasses
import sys
from pathlib import Path
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

import judging
import lom_mixtures

from p2gs_jax.config import CameraFormation, FitConfig
from p2gs_jax.photometry.appearance import exposures_apart
from p2gs_jax.photometry.ppisp import OneView, identity
from p2gs_jax.presets import preset
from p2gs_jax.run.read import Run
from p2gs_jax.types import Params, Photometry, Scene, View

EYE = np.eye(4, dtype=np.float32)


def run_of(cfg: FitConfig, appearance=None) -> Run:
    """Return a run of four training views, of groups high, low, high, low."""
    views = [
        View(f"{name}.JPG", Path(f"{name}.JPG"), "0", EYE, EYE[:3, :3], 8, 8) for name in "abcd"
    ]
    scene = Scene(
        Path(), "colmap", tuple(views), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    )
    photometry = Photometry(jnp.log(jnp.array([2.0, 0.1, 8.0, 0.2])), jnp.zeros(4))
    params = Params(cast(Any, None), photometry, appearance)
    return Run(Path(), params, cfg, scene, None, cast(Any, {"views": []}))


GROUPS = {"a": "high", "b": "low", "c": "high", "d": "low"}


def test_the_common_exposure_is_the_geometric_mean_of_a_group():
    run = run_of(preset("robust"))
    rows = lom_mixtures.rows_of_group(run, GROUPS, "high")
    assert rows == [0, 2]
    display = judging.common_display(run, rows)
    assert display(1).exposure == pytest.approx(4.0)
    assert display(1) == display(0)
    with pytest.raises(SystemExit, match="no training view"):
        lom_mixtures.rows_of_group(run, GROUPS, "over_exp")


def test_corrections_are_averaged_over_the_group():
    corrections = jnp.arange(4.0)[:, None, None] * jnp.ones((4, 3, 4))
    run = run_of(preset("3dgs_affine"), corrections)
    shown = judging.common_display(run, [1, 3])(0)
    assert shown.correction is not None
    np.testing.assert_allclose(shown.correction, 2.0)


def test_a_learned_camera_keeps_what_is_the_cameras():
    learned = identity(["0"] * 4)
    learned = dataclasses.replace(
        learned,
        exposures=jnp.array([1.0, -3.0, 2.0, -2.0]),
        colors=learned.colors.at[0, 6:].set(2.0),
        vignettings=learned.vignettings.at[:, :, 2].set(-0.5),
    )
    run = run_of(preset("ppisp"), learned)
    shown = judging.common_display(run, [0, 2])(0).correction
    assert isinstance(shown, OneView)
    assert float(shown.exposure) == 1.5
    np.testing.assert_array_equal(shown.vignetting, learned.vignettings[0])
    # As a finished run has it: the exposures are where all others have theirs.
    photometry = dataclasses.replace(run.params.photometry, raw_exposures=jnp.zeros(4))
    params = exposures_apart(dataclasses.replace(run.params, photometry=photometry))
    assert not np.asarray(params.appearance.exposures).any()
    found = judging.found_by(dataclasses.replace(run, params=params))
    assert found.exposures_ev is not None
    assert found.balance_ev is not None
    np.testing.assert_allclose(found.exposures_ev[1:], [-3, 2, -2], atol=1e-3)
    np.testing.assert_allclose(found.balance_ev[1:], 0, atol=1e-3)
    # Its control point moved towards red and green.
    assert found.balance_ev[0, 2] < -0.05
    # 8 x 8 pixels: r^2 is 2 (3.5 / 8)^2 in the middle of a corner's pixel.
    assert found.corners == pytest.approx({"0": 1 - 0.5 * 2 * (3.5 / 8) ** 2})


def test_presets_that_are_not_there_are_skipped(capsys):
    found = judging.configs(("3dgs", "nobody"), steps=5)
    assert list(found) == ["3dgs"]
    assert found["3dgs"].train.steps == 5
    assert "nobody is skipped" in capsys.readouterr().err


def test_spreads_are_those_of_solved_exposures_only():
    run = run_of(preset("robust"))
    assert lom_mixtures.spreads(run, GROUPS) == pytest.approx({"high": 1.0, "low": 0.5})
    learned = dataclasses.replace(run.params.photometry, raw_exposures=jnp.zeros(4))
    params = dataclasses.replace(run.params, photometry=learned)
    plain = dataclasses.replace(run_of(preset("3dgs")), params=params)
    assert lom_mixtures.spreads(plain, GROUPS) == {}


def test_what_cameras_do_is_read_from_where_a_run_keeps_it():
    cfg = preset("robust")
    lens = CameraFormation("0", vignetting=((-0.2, 0.0, -0.1),))
    cfg = dataclasses.replace(cfg, photometry=dataclasses.replace(cfg.photometry, cameras=(lens,)))
    found = judging.found_by(run_of(cfg))
    assert found.exposures_ev == pytest.approx(np.log2([2.0, 0.1, 8.0, 0.2]))
    assert found.corners == pytest.approx({"0": np.exp(-0.3)})
    np.testing.assert_array_equal(found.balance_ev, 0)
    assert judging.found_by(run_of(preset("robust"))).corners == {"0": 1.0}
    assert judging.found_by(run_of(preset("3dgs_affine"), jnp.zeros((4, 3, 4)))).corners is None


def test_rows_without_a_value_have_empty_cells():
    rows = [
        {"method": "calibrate", "spread_low": 0.01},
        {"method": "3dgs", "failed": "no light"},
        {"method": "robust", "spread_low": 0.02, "spread_high": 0.03, "own_exposure": 25.0}
        | {"own_all": 26.0, "common": 24.0, "steps": 600, "seconds": 61.0},
    ]
    lines = judging.to_markdown(rows, lom_mixtures.columns(("low", "high"))).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2] == "| calibrate | 0.010 |  |  |  |  |  |  |"
    assert "no light" in lines[3]
    assert lines[4] == "| robust | 0.020 | 0.030 | 25.00 | 26.00 | 24.00 | 600 | 61 |"


def test_pictures_stay_outside_the_project(monkeypatch):
    inside = Path(lom_mixtures.__file__).parent / "results"
    monkeypatch.setattr(sys, "argv", ["x", "scene", "--out", str(inside)])
    with pytest.raises(SystemExit, match="inside this project"):
        lom_mixtures.main()
    monkeypatch.setattr(sys, "argv", ["x", "scene", "--groups", "low"])
    with pytest.raises(SystemExit, match="needs high"):
        lom_mixtures.main()
