"""A fit leaves its metering; a run of an older version is metered when somebody asks."""

import shutil

import numpy as np

from p2gs_jax.run.folder import (
    RunFolder,
)
from p2gs_jax.run.read import load_run


def test_a_run_without_the_file_meters_the_same(finished_run, tmp_path):
    saved = load_run(finished_run)
    assert RunFolder(finished_run).metering.is_file()
    assert saved.metering.names == tuple(v.name for v in saved.scene.training_views)
    old = tmp_path / "old"
    shutil.copytree(finished_run, old)
    RunFolder(old).metering.unlink()
    again = load_run(old).metering
    np.testing.assert_allclose(again.readings, saved.metering.readings, atol=1e-4)
    assert again.rule.meters == saved.metering.rule.meters
    assert again.sentence == saved.metering.sentence
