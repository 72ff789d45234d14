"""A fit leaves its metering, and a reader finds it."""

from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.read import load_run


def test_a_run_has_its_metering(finished_run):
    saved = load_run(finished_run)
    assert RunFolder(finished_run).metering.is_file()
    assert saved.metering.names == tuple(v.name for v in saved.scene.training_views)
