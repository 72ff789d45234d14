"""The scripts of experiments/, without a fit: they import, and judge and print as they say."""

import dataclasses
import importlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import at_size
import drive_cases
import jax.numpy as jnp
import judging
import lom_low
import lom_mixtures
import mixtures
import numpy as np
import published_rows
import pytest
import selection_on_drive
import sensor_town
import time_to_quality
import write_page
from reliability import run as reliability
from reliability.families.safety import PACKAGE, TRUSTED, unsafe_calls
from reliability.family import Family

from p2gs_jax import preset
from p2gs_jax.config import CameraFormation
from p2gs_jax.photometry.appearance import exposures_apart
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.ppisp import OneView, identity
from p2gs_jax.photometry.response import Response
from p2gs_jax.run.read import Run
from p2gs_jax.types import Params, Photometry, Scene, View

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


@pytest.mark.parametrize("path", sorted(EXPERIMENTS.glob("*.py")), ids=lambda path: path.stem)
def test_every_script_finds_what_it_imports(path):
    assert importlib.import_module(path.stem).__doc__


# ------------------------------------------------------------------ reliability


@pytest.mark.parametrize("name", sorted(reliability.families()))
def test_families_keep_the_contract(name):
    module = reliability.families()[name]
    assert name == module.NAME
    assert module.ABOUT
    assert callable(module.run)


def test_a_part_never_replaces_the_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(reliability, "HERE", tmp_path)
    for name, tried, quick in (("b", 1, False), ("a", 2, False), ("a", 3, True), ("b", 4, False)):
        reliability.record(Family(name, tried, tried), quick)
    (path,) = tmp_path.iterdir()
    found = {e["family"]["name"]: e["family"]["tried"] for e in json.loads(path.read_text())}
    assert found == {"a": 2, "b": 4}


def test_the_package_calls_nothing_unsafe(tmp_path):
    assert unsafe_calls(PACKAGE) == list(TRUSTED)
    for number, call in enumerate(
        ("eval(x)", "pickle.load(f)", "np.load(p)", "subprocess.run(x, shell=True)")
    ):
        (tmp_path / f"{number}.py").write_text(f"{call}\n")
    (tmp_path / "safe.py").write_text("np.load(p, allow_pickle=False)\nsubprocess.run([x])\n")
    assert len(unsafe_calls(tmp_path)) == 4


# ------------------------------------------------------------------ drives of known cameras

RICH = drive_cases.Case("iso4", "by camera", tint="view", corners="channel")


@pytest.fixture(scope="module")
def drawn():
    return drive_cases.draw(RICH, 1)


def solution(drawn: drive_cases.Drawn, **changes: Any) -> Any:
    """Return what a solver would that found everything in RICH, but for some changes."""
    lenses = (
        CameraFormation("x", tuple((float(np.log(light)), 0.0, 0.0) for light in row))
        for row in drawn.corners
    )
    known = {
        "model": "view_exposure",
        "white_balance_level": "view",
        "vignetting": "channel",
        "response": Response("srgb", (0.0,) * 20, "camera"),
        "white_balance": np.log(drawn.balance) + np.array([0.2, -0.1, -0.1]),
        "cameras": tuple(lenses),
        "log_exposures": np.log(drawn.exposures),
    }
    return cast(Any, SimpleNamespace(**(known | changes)))


def test_there_are_many_cases_and_each_says_what_is_true():
    names = [case.name for case in drive_cases.CASES]
    assert len(set(names)) == len(names) >= 90
    case = drive_cases.Case
    assert case("constant", "filmic").response is None
    assert case("cameras", tint="camera").model == "camera_exposure"
    # A white balance per view is sought beside an exposure per view only.
    assert case("constant", tint="view").model == "view_exposure"
    assert (RICH.vignetting, RICH.response, RICH.responses) == ("channel", "spline", "camera")


def test_what_was_found_is_right_in_every_part_or_counts_as_wrong(drawn):
    assert all(selection_on_drive.parts_right(solution(drawn), RICH).values())
    assert selection_on_drive.balance_error(solution(drawn), drawn) == pytest.approx(0, abs=1e-9)
    assert selection_on_drive.corner_error(solution(drawn), drawn) == pytest.approx(0, abs=1e-9)
    for part, change in (
        ("model", {"model": "view_exposure_gamma"}),
        ("white_balance", {"white_balance_level": "camera"}),
        ("vignetting", {"vignetting": "camera"}),
        ("response", {"response": Response("srgb", (0.0,) * 20)}),
    ):
        right = selection_on_drive.parts_right(solution(drawn, **change), RICH)
        assert [name for name, true in right.items() if not true] == [part]
    none = solution(drawn, cameras=())
    expected = 100 * drive_cases.CORNERS["channel"].mean()
    assert selection_on_drive.corner_error(none, drawn) == pytest.approx(expected)


def test_errors_of_exposures_and_of_their_error_bars(drawn):
    logs = np.log(drawn.exposures) + 0.5 * drawn.observations.cameras
    ev, _ = selection_on_drive.exposure_errors(logs, drawn, by_camera=True)
    assert ev == pytest.approx(0, abs=1e-9)
    assert selection_on_drive.exposure_errors(logs, drawn, by_camera=False)[0] > 0.3
    logs = 1.1 * (np.log(drawn.exposures) + np.tile([0.02, -0.02], 30)) + 3
    found = solution(drawn, log_exposures=logs, exposure_errors=np.full(60, 0.01))
    ratio = selection_on_drive.over_stated(found, drawn, by_camera=False)
    assert ratio == pytest.approx(2, rel=0.05)


def test_factors_per_channel_are_those_that_fit_all_pictures():
    rng = np.random.default_rng(0)
    linear = rng.uniform(0.05, 0.4, (2, 12, 10, 3))
    true = np.array([0.7, -0.4, 0.1])
    targets, masks = list(linear * 2**true), [np.ones((12, 10)), np.zeros((12, 10))]
    targets[1] = targets[1] + 0.5  # masked
    found = sensor_town._fitted_factors(lambda ev: list(linear * 2**ev), targets, masks)
    np.testing.assert_allclose(found, true, atol=3e-3)


# ------------------------------------------------------------------ mixtures

EYE = np.eye(4, dtype=np.float32)
GROUPS = {"a": "high", "b": "low", "c": "high", "d": "low"}


def run_of(cfg, appearance=None) -> Run:
    """Return a run of four training views, of groups high, low, high, low."""
    views = [
        View(f"{name}.JPG", Path(f"{name}.JPG"), "0", EYE, EYE[:3, :3], 8, 8) for name in GROUPS
    ]
    points = np.zeros((0, 3), np.float32)
    scene = Scene(Path(), "colmap", tuple(views), points, points.astype(np.uint8))
    photometry = Photometry(jnp.log(jnp.array([2.0, 0.1, 8.0, 0.2])), jnp.zeros(4))
    params = Params(cast(Any, None), photometry, appearance)
    return Run(Path(), params, cfg, scene, None, cast(Any, {"views": []}))


def test_the_common_exposure_is_the_geometric_mean_of_a_group():
    run = run_of(preset("robust"))
    rows = lom_mixtures.rows_of_group(run, GROUPS, "high")
    display = judging.common_display(run, rows)
    assert display(1).exposure == pytest.approx(4.0)
    assert lom_mixtures.spreads(run, GROUPS) == pytest.approx({"high": 1.0, "low": 0.5})
    with pytest.raises(SystemExit, match="no training view"):
        lom_mixtures.rows_of_group(run, GROUPS, "over_exp")
    corrected = run_of(preset("3dgs_affine"), jnp.arange(4.0)[:, None, None] * jnp.ones((4, 3, 4)))
    np.testing.assert_allclose(judging.common_display(corrected, [1, 3])(0).correction, 2.0)


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
    # As a finished run has it: the exposures are where all others have theirs.
    photometry = dataclasses.replace(run.params.photometry, raw_exposures=jnp.zeros(4))
    params = exposures_apart(dataclasses.replace(run.params, photometry=photometry))
    found = judging.found_by(dataclasses.replace(run, params=params))
    np.testing.assert_allclose(found.exposures_ev[1:], [-3, 2, -2], atol=1e-3)
    # Its control point moved towards red and green.
    assert found.balance_ev[0, 2] < -0.05
    # 8 x 8 pixels: r^2 is 2 (3.5 / 8)^2 in the middle of a corner's pixel.
    assert found.corners == pytest.approx({"0": 1 - 0.5 * 2 * (3.5 / 8) ** 2})


def test_tables_of_methods_have_a_cell_for_every_column():
    rows = [{"method": "calibrate", "spread_low": 0.01}, {"method": "3dgs", "failed": "no light"}]
    lines = judging.to_markdown(rows, lom_mixtures.columns(("low", "high"))).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2] == "| calibrate | 0.010 |  |  |  |  |  |  |"
    assert "no light" in lines[3]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("scene", "--out", str(EXPERIMENTS)), "inside this project"),
        (("s", "--groups", "low"), "high"),
    ],
)
def test_pictures_stay_outside_the_project(monkeypatch, words, message):
    monkeypatch.setattr(sys, "argv", ["x", *words])
    with pytest.raises(SystemExit, match=message):
        lom_mixtures.main()


def test_the_mixture_is_drawn_in_the_order_of_names(tmp_path):
    views = [f"v{i}" for i in range(20)]
    drawn = mixtures.mixture_groups(views[::-1])
    assert set(drawn.values()) == set(mixtures.GROUPS)
    for group in mixtures.GROUPS:
        (tmp_path / "lom" / group).mkdir(parents=True)
        for view in views:
            (tmp_path / "lom" / group / f"{view}.JPG").write_text(group)
    (tmp_path / "lom" / "colmap_sparse" / "0").mkdir(parents=True)
    mixtures.write_mixture(tmp_path / "lom", tmp_path / "out")
    assert mixtures.read_groups(tmp_path / "out") == drawn
    for view, group in drawn.items():
        assert (tmp_path / "out" / "images" / f"{view}.JPG").read_text() == group


# ------------------------------------------------------------------ rows of published benchmarks

PUBLISHED = json.loads((published_rows.HERE / "published.json").read_text(encoding="utf-8"))
KEY = published_rows.Key("lego", "lego", "3dgs", 30_000)
ROW = {
    "figures": {"psnr": 34.0, "ssim": 0.98},
    **{"gaussians": 1000, "seconds": 60, "commit": "abc", "command": "p2gs-jax fit LEGO"},
}


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
            published_rows.measure(wanted, row_of, path=path)
    assert measured == [1, 2, 3, 3]
    published_rows.measure(wanted[:1], row_of, again=True, path=path)
    assert measured[-1] == 1
    assert set(published_rows.read_rows(path)) == set(wanted[:2])


def test_a_fit_is_kept_with_what_made_it(tmp_path, monkeypatch):
    run, fits = tmp_path / "runs" / "3dgs_20", []
    monkeypatch.setattr(published_rows, "commit", lambda: f"commit {len(fits)}")

    def fit(words, check):
        fits.append(words[words.index("fit") :])
        run.mkdir(exist_ok=True)
        (run / "config.json").write_text("{}")
        if len(fits) > 1:
            (run / "metrics.json").write_text(json.dumps({"psnr": len(fits)}))
        return SimpleNamespace(returncode=int(len(fits) == 1))

    monkeypatch.setattr(published_rows.subprocess, "run", fit)
    given = (Path("lego"), run, ("--preset", "3dgs"))
    with pytest.raises(SystemExit, match="ended with 1"):
        published_rows.fitted(*given)
    kept = published_rows.Fit({"psnr": 2}, "commit 0, then commit 1")
    assert [published_rows.fitted(*given), published_rows.fitted(*given)] == [kept, kept]
    assert ["--resume" in words for words in fits] == [False, True]
    with pytest.raises(SystemExit, match="was not fitted with lego --preset robust"):
        published_rows.fitted(Path("lego"), run, ("--preset", "robust"))
    # Measured again, nothing of the old fit is left.
    assert published_rows.fitted(*given, again=True).commit == "commit 2"
    assert "--resume" not in fits[-1]


def test_the_page_in_the_repository_is_that_of_its_rows():
    page = write_page.page(PUBLISHED, {KEY: ROW}, {})
    assert "| lego | 3dgs | 30000 | 34.00 | 0.980 | -1.78 | 1000 | 60 | abc |" in page
    assert write_page.OUT.read_text(encoding="utf-8") == write_page.page(
        PUBLISHED, published_rows.read_rows(), published_rows.read_rows(write_page.AT_SIZE)
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


def test_corrections_at_size_take_rates_of_their_own_but_for_dusk():
    key = at_size.Key(at_size.BENCHMARK, "ISO std 4", "3dgs_affine", 7000)
    plain = ("--preset", "3dgs_affine", "--steps", "7000")
    assert at_size.options_of(key)[:6] == (*plain, "--optimizer.appearance", "0.003")
    assert at_size.options_of(key._replace(scene=at_size.DUSK)) == plain


def test_time_to_quality_compares_with_the_best_of_the_other():
    points = [(10.0, 20.0), (40.0, 22.0)]
    assert time_to_quality.seconds_to(points, 21.0) == pytest.approx(20.0)
    assert time_to_quality.seconds_to(points, 23.0) is None
    rows = [
        {"scene": "town", "version": version, "commit": "c", "budget": s, "wall_s": s}
        | {"test_psnr": psnr}
        for version, s, psnr in (
            ("this", 60.0, 21.0),
            ("this", 120.0, 23.0),
            ("against", 120.0, 21.0),
        )
    ]
    assert time_to_quality.speedups(rows) == [
        "town: 21.00 dB takes the other 120 s; here: in 60 s, 2.00 times as fast"
    ]
    assert len({line.count("|") for line in time_to_quality.table(rows).splitlines()}) == 1
