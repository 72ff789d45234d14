"""`p2gs-jax compare`: one table, one page."""

import re

import numpy as np
import pytest
from page_tools import copy_run, edit, look_at

from p2gs_jax.cli import main
from p2gs_jax.report import compare
from p2gs_jax.report.compare import compare_runs, to_markdown
from p2gs_jax.report.compare_page import comparison_page


@pytest.fixture(scope="module")
def runs(finished_run, tmp_path_factory):
    """A run, and another of the same scene under other options with other results."""
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


def test_the_table_holds_every_run_and_marks_the_best(runs):
    found = compare_runs(runs)
    assert found.labels == ("plain", "other")
    assert found.same_scene
    assert row(found, "preset").cells == ("robust", "paper")
    train = row(found, "training PSNR, dB")
    assert float(train.cells[0]) - float(train.cells[1]) == pytest.approx(1.0, abs=0.011)
    assert train.best == {0}
    assert row(found, "held-out PSNR, fitted exposure, dB").best == {1}
    assert row(found, "training SSIM").best == frozenset()
    assert row(found, "Gaussians").best == frozenset()


def test_no_star_is_announced_where_scores_do_not_compare(runs, tmp_path, monkeypatch, capsys):
    for different in (False, True):
        if different:
            monkeypatch.setattr(compare, "_same_scene", lambda first, other: False)
        with pytest.raises(SystemExit):
            main(["compare", *map(str, runs), "--out", str(tmp_path / "compare.html")])
        printed = capsys.readouterr().out
        assert ("* best" in printed) is not different
        assert "seconds, whole run" in printed


def test_options_that_differ_and_no_others(runs):
    found = {r.name: r.cells for r in compare_runs(runs).options}
    assert found == {"preset": ("robust", "paper"), "train.seed": ("0", "7")}


def test_exposures_without_their_gauge(runs):
    ((label, x, y),) = compare_runs(runs).exposures
    assert label == "other"
    assert x.mean() == pytest.approx(0, abs=1e-9)
    assert y.mean() == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(np.abs(y - x), 0.1, atol=1e-6)


def test_command_page_and_markdown(runs, tmp_path, capsys):
    out = tmp_path / "pages" / "compare.html"
    with pytest.raises(SystemExit) as stop:
        main(["compare", *map(str, runs), "--out", str(out)])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert "training PSNR" in printed
    assert "train.seed" in printed
    text = out.read_text()
    headings = re.findall(r"<h2>(.*?)</h2>", text)
    assert headings == [
        *("Scores", "Options that differ", "Exposures against each other"),
        "The same held-out views",
    ]
    assert text.count("data:image/jpeg") == 2 * 3
    table = out.with_suffix(".md").read_text()
    assert "| preset | robust | paper |" in table
    assert re.search(r"\| training PSNR, dB \| \*\*\d", table)
    assert "differ by 0.100 stops" in table


@pytest.mark.parametrize("width", [300, 1600])
def test_in_a_browser(browser, runs, tmp_path, width):
    path = tmp_path / "compare.html"
    path.write_text(comparison_page(compare_runs([*runs, runs[0]])), encoding="utf-8")
    found = look_at(browser, path, width)
    assert found["fetched"] == [path.as_uri()]
    assert found["said"] == []
    assert found["content"] <= width
    assert found["smallest"] >= 9
    assert found["spilled"] == []
    assert all(complete and natural > 0 for complete, natural, _ in found["images"])


def test_runs_of_different_scenes_get_a_table_and_a_sentence(runs, tmp_path):
    stranger = copy_run(runs[1], tmp_path / "stranger")
    edit(stranger / "config.json", lambda c: c.update(scene="/elsewhere/castle"))
    for file in (stranger / "renders").glob("*.photograph.png"):
        file.write_bytes((runs[0] / "renders" / file.name).read_bytes()[:100])
    found = compare_runs([runs[0], stranger])
    assert not found.same_scene
    assert "different scenes" in found.remarks[0]
    assert found.exposures == ()
    assert all(r.best == frozenset() for r in found.scores)
    text = comparison_page(found)
    assert "different scenes" in text
    assert "data:image" not in text


def test_a_moved_scene_is_known_by_its_photographs(runs, tmp_path):
    moved = copy_run(runs[1], tmp_path / "moved")
    edit(moved / "config.json", lambda c: c.update(scene="/elsewhere/scene"))
    assert compare_runs([runs[0], moved]).same_scene


def test_an_unfinished_run_has_empty_cells(runs, tmp_path):
    poor = copy_run(runs[1], tmp_path / "poor")
    (poor / "metrics.json").unlink()
    found = compare_runs([runs[0], poor])
    assert row(found, "training PSNR, dB").cells[1] == ""
    assert any(r.startswith("poor: metrics.json is missing") for r in found.remarks)
    assert "| - |" in to_markdown(found)


def test_runs_of_one_name_are_told_apart(runs, tmp_path):
    twin = copy_run(runs[0], tmp_path / "plain")
    labels = compare_runs([runs[0], twin]).labels
    assert len(set(labels)) == 2
    assert all(label.endswith("/plain") for label in labels)


def test_one_run_is_not_enough(runs, capsys):
    for argv in (["compare", str(runs[0])], ["compare"]):
        with pytest.raises(SystemExit) as stop:
            main(argv)
        assert stop.value.code == 2
        assert "to compare" in capsys.readouterr().err
