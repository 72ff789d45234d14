"""A fit whose photographs lie in files is the fit whose photographs lie in memory."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

from p2gs_jax.pipeline.preflight import check_run_dir
from p2gs_jax.presets import from_dict
from p2gs_jax.scene.pixels import store as held

FIT = (
    *("--steps", "60", "--train.coarse-to-fine", "--test-every", "3"),
    *("--densify.max-gaussians", "400", "--render.sh-degree", "1", "--init.shell", "off"),
)


def test_a_fit_from_files_is_the_same(finished_run, tmp_path, run_command, monkeypatch):
    """As that of `finished_run`, but for its memory; every photograph is decoded once a level."""
    decoded = Counter()
    plain = held.decode

    def counted(view, sizes):
        decoded.update((view.name, size) for size in sizes)
        return plain(view, sizes)

    monkeypatch.setattr(held, "decode", counted)
    run, scene = tmp_path / "run", finished_run.parent / "scene"
    code, said = run_command("fit", scene, "--out", run, *FIT, "--data.cache-mb", "0")
    assert code == 0, said
    assert (run / "radiance.ply").read_bytes() == (finished_run / "radiance.ply").read_bytes()
    assert set(decoded.values()) == {1}
    assert not (run / "cache" / "pixels").exists()


def test_a_full_disk_is_exit_2_before_anything_is_fitted(
    finished_run, tmp_path, run_command, monkeypatch
):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=0))
    run, scene = tmp_path / "run", finished_run.parent / "scene"
    code, said = run_command("fit", scene, "--out", run, *FIT, "--data.cache-mb", "0")
    assert code == 2
    assert "--data.cache-mb" in said
    assert not (run / "config.json").exists()


def test_a_run_may_go_on_with_other_memory(finished_run):
    cfg = from_dict(json.loads((finished_run / "config.json").read_text())["fit"])
    check_run_dir(finished_run, True, replace(cfg, data=replace(cfg.data, cache_mb=17)))
