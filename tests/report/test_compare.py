"""`p2gs-jax compare`: tables of runs, on the terminal and in Markdown."""

import re

import pytest
from page_tools import copy_run, edit

from p2gs_jax.report import compare
from p2gs_jax.report.compare import compare_runs, to_markdown


@pytest.fixture(scope="module")
def runs(finished_run, tmp_path_factory):
    """Return a run, and one of the same scene with other options and other results."""
    root = tmp_path_factory.mktemp("compared")
    first, second = (copy_run(finished_run, root / name) for name in ("plain", "other"))

    def options(config):
        config["fit"]["preset"] = "paper"
        config["fit"]["train"]["seed"] = 7

    def scores(metrics):
        metrics["train"]["psnr"] -= 1.0
        metrics["test"]["exposure_fitted"]["psnr"] += 2.0

    def exposures(photometry):
        for i, view in enumerate(v for v in photometry["views"] if v["exposure"] is not None):
            view["exposure_ev"] += 5.0 + (0.1 if i % 2 else -0.1)

    edit(second / "config.json", options)
    edit(second / "metrics.json", scores)
    edit(second / "photometry.json", exposures)
    return first, second


def row(found, name):
    return next(r for r in found.scores if r.name == name)


def test_tables_hold_every_run_and_mark_the_best(runs):
    found = compare_runs(runs)
    assert found.labels == ("plain", "other")
    assert found.same_scene
    assert row(found, "preset").cells == ("robust", "paper")
    train = row(found, "training PSNR, dB")
    assert float(train.cells[0]) - float(train.cells[1]) == pytest.approx(1.0, abs=0.011)
    best = {"training PSNR, dB": {0}, "held-out PSNR, fitted exposure, dB": {1}}
    for name in (*best, "training SSIM", "Gaussians"):
        assert row(found, name).best == best.get(name, set())
    options = {r.name: r.cells for r in found.options}
    assert options == {"preset": ("robust", "paper"), "train.seed": ("0", "7")}
    # Exposures are compared without their means, because runs have no common gauge.
    ((label, rms, views),) = found.apart
    assert (label, views) == ("other", 4)
    assert rms == pytest.approx(0.1, abs=1e-6)


def test_the_command_prints_tables_and_writes_markdown(runs, tmp_path, monkeypatch, succeeded):
    out = tmp_path / "tables" / "compare.md"
    printed = succeeded("compare", *runs, "--out", out)
    assert all(words in printed for words in ("training PSNR", "train.seed", "* best"))
    table = out.read_text()
    assert "| preset | robust | paper |" in table
    assert re.search(r"\| training PSNR, dB \| [\d.]+ \\\* \| [\d.]+ \|", table)
    assert "differ by 0.100 stops" in table
    # Scores of different scenes get no star.
    monkeypatch.setattr(compare, "_same_scene", lambda first, other: False)
    assert "* best" not in succeeded("compare", *runs, "--out", out)


def test_runs_of_different_scenes_get_a_table_and_a_sentence(runs, tmp_path):
    stranger = copy_run(runs[1], tmp_path / "stranger")
    edit(stranger / "config.json", lambda c: c.update(scene="/elsewhere/castle"))
    # A scene that was moved is recognised by its photographs.
    assert compare_runs([runs[0], stranger]).same_scene
    for file in (stranger / "renders").glob("*.photograph.png"):
        file.write_bytes((runs[0] / "renders" / file.name).read_bytes()[:100])
    other_drive = copy_run(runs[1], tmp_path / "other_drive")
    edit(other_drive / "config.json", lambda c: c["fit"]["data"].update(drive="002"))
    assert not compare_runs([runs[0], other_drive]).same_scene
    found = compare_runs([runs[0], stranger])
    assert not found.same_scene
    assert "different scenes" in found.remarks[0]
    assert found.apart == ()
    assert all(r.best == frozenset() for r in found.scores)


def test_unfinished_runs_have_empty_cells_and_runs_of_one_name_separate_labels(runs, tmp_path):
    poor = copy_run(runs[1], tmp_path / "poor")
    (poor / "metrics.json").unlink()
    found = compare_runs([runs[0], poor])
    assert row(found, "training PSNR, dB").cells[1] == ""
    assert any(r.startswith("poor: metrics.json is missing") for r in found.remarks)
    assert "| - |" in to_markdown(found)
    labels = compare_runs([runs[0], copy_run(runs[0], tmp_path / "plain")]).labels
    assert len(set(labels)) == 2
    assert all(label.endswith("/plain") for label in labels)
