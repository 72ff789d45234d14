"""experiments/time_to_quality.py without a fit: rows, their keys, tables and curves."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

import mixtures
import time_to_quality as t2q

TOWN = t2q.SceneToFit("town", Path("/somewhere/town"), ("--reference", "/somewhere/reference"))
FOX = t2q.SceneToFit("nerf_fox", Path("/data/fox"), ("--max-width", "480"))
NEW = t2q.Version(t2q.THIS, Path("/new"), "aaa", "code-a")
OLD = t2q.Version(t2q.AGAINST, Path("/old"), "bbb", "code-b")


def row(job, wall, psnr, **extra):
    return {
        "version": job.version.label,
        "commit": job.version.commit,
        **job.key,
        "wall_s": wall,
        "test_psnr": psnr,
        **extra,
    }


def test_versions_take_turns_and_cold_runs_come_first():
    jobs = t2q.plan([TOWN, FOX], [NEW, OLD], ["warm", "cold"], [120, 60])
    assert len(jobs) == 16
    assert [j.version.label for j in jobs[:4]] == [t2q.THIS, t2q.AGAINST] * 2
    assert [j.temperature for j in jobs[:4]] == ["cold", "cold", "warm", "warm"]
    assert [j.budget for j in jobs[:8]] == [120] * 4 + [60] * 4


def test_finished_rows_are_kept_and_other_code_is_measured_anew(tmp_path):
    jobs = t2q.plan([TOWN, FOX], [NEW, OLD], ["cold"], [60])
    rows = [row(job, 61.0, 20.0) for job in jobs[:2]]
    path = tmp_path / "rows.json"
    assert t2q.read_rows(path) == []
    t2q.write_rows(path, {"date": "today"}, rows)
    again = t2q.read_rows(path)
    assert t2q.missing(jobs, again) == jobs[2:]
    changed = t2q.Version(t2q.THIS, Path("/new"), "ccc", "code-c")
    assert len(t2q.missing(t2q.plan([TOWN], [changed], ["cold"], [60]), again)) == 1
    assert json.loads(path.read_text())["stamp"] == {"date": "today"}


def test_a_row_does_not_say_where_anything_lies():
    (job,) = t2q.plan([TOWN], [NEW], ["cold"], [60])
    assert "/" not in json.dumps(job.key)


def test_the_table_has_a_cell_for_every_column():
    jobs = t2q.plan([TOWN], [NEW, OLD], ["cold"], [60])
    rows = [row(jobs[0], 61.5, 20.123, ev=0.0123, steps=300), row(jobs[1], 60.0, None)]
    lines = t2q.table(rows).splitlines()
    assert {line.count("|") for line in lines} == {len(t2q.HEADER) + 1}
    assert "20.12" in lines[2]
    assert "0.0123" in lines[2]
    assert "n/a" in lines[3]


def test_when_a_curve_reaches_a_level():
    points = [(10.0, 20.0), (40.0, 22.0)]
    assert t2q.seconds_to(points, 21.0) == pytest.approx(20.0)
    assert t2q.seconds_to(points, 19.0) == 10.0
    assert t2q.seconds_to(points, 23.0) is None
    assert t2q.seconds_to([], 23.0) is None


def test_speedups_compare_with_the_best_of_the_other():
    ours = t2q.plan([TOWN], [NEW], ["warm"], [120, 60])
    theirs = t2q.plan([TOWN], [OLD], ["warm"], [60, 120])
    rows = [row(j, j.budget, v) for j, v in zip(ours, (23.0, 21.0), strict=True)]
    rows += [row(j, j.budget, v) for j, v in zip(theirs, (21.0, 20.0), strict=True)]
    (said,) = t2q.speedups(rows)
    assert "at most 60 s here: 2.00 times" in said
    rows = [row(j, j.budget, v) for j, v in zip(ours, (19.5, 19.0), strict=True)] + rows[2:]
    assert "not reached here (best 19.50 dB)" in t2q.speedups(rows)[0]
    assert len(t2q.plot(rows).axes) == 1


def test_quality_is_read_where_metrics_have_it():
    metrics = {
        "counts": {"steps": 7, "gaussians": 9},
        "test": {"exposure_fitted": {"psnr": 21.0}},
        "reference": {"scale_aligned": {"test": {"psnr": 20.0}}},
    }
    found = t2q.quality(metrics)
    assert (found["steps"], found["test_psnr"], found["reference_test_psnr"]) == (7, 21.0, 20.0)
    assert found["train_psnr"] is None


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


def test_seconds_of_compiling_are_counted():
    said = "Finished XLA compilation of jit(step) in 1.25 sec\nnothing\n"
    assert t2q.compiling(said * 2) == (2, 2.5)


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


def test_runs_use_their_own_code_and_an_own_cache(monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/mine")
    found = t2q.environment(Path("/code"), Path("/cache"), Path("/fonts"))
    assert found["PYTHONPATH"] == "/code"
    assert found["XDG_CACHE_HOME"] == "/cache"
    assert "JAX_COMPILATION_CACHE_DIR" not in found


def test_absent_scenes_are_skipped_with_a_message(tmp_path, capsys):
    found = t2q.scenes(["nerf_fox", "sofa"], tmp_path, tmp_path / "none", None, quick=False)
    assert found == []
    assert capsys.readouterr().err.count("is skipped") == 2


def test_a_cold_run_starts_empty_and_leaves_its_programs_where_they_are_found(tmp_path):
    cache = tmp_path / "caches" / "town"
    for name in ("first", "second"):
        with t2q.emptied(cache) as folder:
            assert folder == cache
            assert list(folder.iterdir()) == []
            (folder / name).write_text("")
    assert {f.name for f in cache.iterdir()} == {"first", "second"}
    with pytest.raises(RuntimeError), t2q.emptied(cache):
        raise RuntimeError("a fit failed")
    assert {f.name for f in cache.iterdir()} == {"first", "second"}
    assert [f.name for f in cache.parent.iterdir()] == ["town"]
