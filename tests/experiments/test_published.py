"""experiments/published without a fit: rows are kept, the page is written from them alone."""

import dataclasses
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments" / "published"))

import lom_low
import published_rows as rows
import write_page

from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.presets import preset

PUBLISHED = json.loads((rows.HERE / "published.json").read_text(encoding="utf-8"))
KEY = rows.Key("lego", "lego", "3dgs", 30_000)
ROW = {
    "figures": {"psnr": 34.0, "ssim": 0.98},
    **{"gaussians": 1000, "seconds": 60, "commit": "abc", "command": "p2gs-jax fit LEGO"},
}


def test_rows_are_kept_one_by_one_and_replaced(tmp_path):
    path = tmp_path / "rows.json"
    assert rows.read_rows(path) == {}
    rows.add_row(KEY, ROW, path)
    other = KEY._replace(steps=7000)
    rows.add_row(other, ROW, path)
    rows.add_row(KEY, {**ROW, "seconds": 61}, path)
    kept = rows.read_rows(path)
    assert set(kept) == {KEY, other}
    assert kept[KEY]["seconds"] == 61


def test_what_is_there_is_not_measured_again(tmp_path):
    path, measured = tmp_path / "rows.json", []

    def row_of(key):
        measured.append(key.steps)
        if key.steps == 3:
            raise SystemExit("interrupted")
        return ROW

    wanted = [KEY._replace(steps=s) for s in (1, 2, 3, 4)]
    for _ in range(2):
        with pytest.raises(SystemExit):
            rows.measure(wanted, row_of, path=path)
    assert measured == [1, 2, 3, 3]
    rows.measure(wanted[:1], row_of, again=True, path=path)
    assert measured[-1] == 1


def test_a_fit_is_kept_with_what_made_it(tmp_path, monkeypatch):
    run, fits = tmp_path / "runs" / "3dgs_20", []
    monkeypatch.setattr(rows, "commit", lambda: f"commit {len(fits)}")

    def fit(words, check):
        fits.append(words[words.index("fit") :])
        run.mkdir(exist_ok=True)
        (run / "config.json").write_text("{}")
        if len(fits) > 1:
            (run / "metrics.json").write_text(json.dumps({"psnr": len(fits)}))
        return SimpleNamespace(returncode=int(len(fits) == 1))

    monkeypatch.setattr(rows.subprocess, "run", fit)
    given = (Path("lego"), run, ("--preset", "3dgs"))
    with pytest.raises(SystemExit, match="ended with 1"):
        rows.fitted(*given)
    for _ in range(2):
        assert rows.fitted(*given) == rows.Fit({"psnr": 2}, "commit 0, then commit 1")
    assert ["--resume" in words for words in fits] == [False, True]
    with pytest.raises(SystemExit, match="was not fitted with lego --preset robust"):
        rows.fitted(Path("lego"), run, ("--preset", "robust"))
    # Measured again, nothing of the old fit is left.
    assert rows.fitted(*given, again=True) == rows.Fit({"psnr": 3}, "commit 2")
    assert "--resume" not in fits[-1]


def test_the_page_sets_figures_beside_published_ones():
    hdr = {KEY._replace(scene="ISO std 4"): {**ROW, "figures": {write_page.HDR: 36.214}}}
    page = write_page.page(PUBLISHED, {KEY: ROW}, hdr)
    assert "| lego | 3dgs | 30000 | 34.00 | 0.980 | -1.78 | 1000 | 60 | abc |" in page
    assert "| ISO std 4 | 3dgs | 30000 | 36.21 | abc |" in page
    assert write_page.NOT_RUN in page
    assert "| sofa | Aleth-NeRF | 19.52 |" in page
    with pytest.raises(SystemExit, match="unheard"):
        write_page.page(PUBLISHED, {KEY._replace(benchmark="unheard"): ROW}, {})


def test_the_page_in_the_repository_is_that_of_its_rows():
    assert write_page.OUT.read_text(encoding="utf-8") == write_page.page(
        PUBLISHED, rows.read_rows(), rows.read_rows(write_page.AT_SIZE)
    )


def test_held_out_views_are_the_authors(tmp_path):
    frames = [{"file_path": f"high/{n}.JPG"} for n in ("1", "17")]
    (tmp_path / "transforms_test.json").write_text(json.dumps({"frames": frames}))
    stems = lom_low.their_test_views(tmp_path)
    views = [SimpleNamespace(name=f"{n}.JPG") for n in ("1", "10", "17", "9")]
    scene = SimpleNamespace(views=views, test_indices=(0, 2, 3))
    run = SimpleNamespace(scene=scene, folder="run")
    assert lom_low.judged_rows(run, stems) == [0, 2]
    scene.test_indices = (0, 3)
    with pytest.raises(SystemExit, match="views 17"):
        lom_low.judged_rows(run, stems)


def test_alignments_find_what_was_done_to_the_light():
    tone = dataclasses.replace(preset("robust").photometry, curve="srgb")
    plain = DisplayTransform(1.0, 2.2, tone)
    linear = np.random.default_rng(0).uniform(0.02, 0.3, (16, 20, 3)).astype(np.float32)
    bright = dataclasses.replace(plain, exposure=2.5)
    aligned = object.__new__(lom_low.Aligned)
    aligned.run = SimpleNamespace(cfg=preset("robust"))
    aligned._usual = aligned._plain = plain
    aligned._training = [(linear, develop(linear, bright), np.ones((16, 20), np.float32))]
    found = aligned.displays()
    assert set(found) == {"unaligned", "mean_half", "exposure", "all"}
    assert found["exposure"].exposure == pytest.approx(2.5, rel=2e-3)
    shown = develop(linear, found["mean_half"])
    assert shown[::4, ::4].mean() == pytest.approx(0.5, abs=1e-3)
    assert found["unaligned"].exposure == 1.0
