"""experiments/time_to_quality.py and mixtures.py without a fit: rows, tables, curves, groups."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

import mixtures
import time_to_quality as t2q

TOWN = t2q.SceneToFit("town", Path("/somewhere/town"), ("--reference", "/somewhere/reference"))
NEW = t2q.Version(t2q.THIS, Path("/new"), "aaa", "code-a")
OLD = t2q.Version(t2q.AGAINST, Path("/old"), "bbb", "code-b")


def row(version, budget, wall, psnr):
    keys = {"scene": "town", "version": version.label, "commit": version.commit}
    return {**keys, "code": version.code, "budget": budget, "wall_s": wall, "test_psnr": psnr}


def test_a_row_belongs_to_the_code_it_was_measured_with():
    kept = row(NEW, 60, 61.0, 20.0)
    assert t2q.Job(TOWN, NEW, 60).of(kept)
    others = (NEW._replace(code="code-c"), 60), (OLD, 60), (NEW, 120)
    assert not any(t2q.Job(TOWN, version, budget).of(kept) for version, budget in others)


def test_curves_tables_and_speedups():
    points = [(10.0, 20.0), (40.0, 22.0)]
    assert t2q.seconds_to(points, 21.0) == pytest.approx(20.0)
    assert t2q.seconds_to(points, 19.0) == 10.0
    assert t2q.seconds_to(points, 23.0) is None
    assert t2q.seconds_to([], 23.0) is None
    rows = [row(NEW, 60, 60.0, 21.0), row(NEW, 120, 120.0, 23.0)]
    rows += [row(OLD, 60, 60.0, None), row(OLD, 120, 120.0, 21.0)]
    assert t2q.speedups(rows) == [
        "town: 21.00 dB takes the other 120 s; here: in 60 s, 2.00 times as fast"
    ]
    lines = t2q.table(rows).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert "21.00" in lines[2]
    assert "n/a" in lines[4]
    assert len(t2q.plot(rows).axes) == 1


def test_exposures_are_judged_by_truth_or_within_their_groups():
    evs = {"a.png": 0.0, "b.png": 1.0, "c.png": 1.2, "held.png": None}
    photometry = {"views": [{"image": k, "exposure_ev": v} for k, v in evs.items()]}
    truth = {k: 3 * 2.0**v for k, v in evs.items() if v is not None}
    assert t2q.true_ev(photometry, truth) == pytest.approx(0.0, abs=1e-9)
    assert t2q.true_ev(photometry, {}) is None
    groups = {"a": "low", "b": "high", "c": "high", "held": "low"}
    within = mixtures.within_groups_ev(photometry, groups)
    assert within == pytest.approx((2 * 0.1**2 / 3) ** 0.5)
    assert mixtures.within_groups_ev(photometry, {}) is None


def test_the_mixture_is_drawn_in_the_order_of_names(tmp_path):
    views = [f"v{i}" for i in range(20)]
    groups = mixtures.mixture_groups(views[::-1])
    assert groups == mixtures.mixture_groups(views)
    assert set(groups.values()) == set(mixtures.GROUPS)
    for group in mixtures.GROUPS:
        (tmp_path / "lom" / group).mkdir(parents=True)
        for view in views:
            (tmp_path / "lom" / group / f"{view}.JPG").write_text(group)
    (tmp_path / "lom" / "colmap_sparse" / "0").mkdir(parents=True)
    mixtures.write_mixture(tmp_path / "lom", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "groups.json").read_text()) == groups
    for view, group in groups.items():
        assert (tmp_path / "out" / "images" / f"{view}.JPG").read_text() == group
        reference = tmp_path / "out" / "reference" / f"{view}.JPG"
        assert reference.read_text() == mixtures.REFERENCE


def test_absent_scenes_are_skipped_with_a_message(tmp_path, capsys):
    assert t2q.scenes(["nerf_fox", "sofa"], tmp_path, tmp_path / "none") == []
    assert capsys.readouterr().err.count("is skipped") == 2
