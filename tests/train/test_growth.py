"""Automatic growth: views are left out and return, and growth ends where it gains nothing."""

import dataclasses
import json
import math

import numpy as np
import pytest
from tiny_scene import make_scene

import p2gs_jax
from p2gs_jax.cli import main
from p2gs_jax.config import from_dict, to_dict
from p2gs_jax.core.progress import Silent
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.train import growth
from p2gs_jax.train.growth import Growth, StageResult
from p2gs_jax.train.host import HostState
from p2gs_jax.train.strategies import automatic
from p2gs_jax.train.validation import pick_validation
from p2gs_jax.train.views import TrainingViews

SMALL = with_fields(
    p2gs_jax.preset("robust"),
    {
        "train.steps": 100,
        "train.log_every": 5,
        "train.coarse_to_fine": [],
        "densify.min_every_steps": 5,
        "densify.max_gaussians": "auto",
        "render.sh_degree": 0,
        "data.test_every": 0,
    },
)


def population(params, living):
    """Stand in for a held-out PSNR to which every Gaussian adds."""
    return 10 * math.log(float(living.alive.sum()))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("growth") / "scene", views=12)


@pytest.fixture(autouse=True)
def short_stages(monkeypatch):
    monkeypatch.setattr(growth, "FEWEST_STEPS", 15)


@pytest.fixture
def taken(monkeypatch):
    """Return a list that receives the view of every batch, and nothing of those of the judge."""
    rows = []
    original = TrainingViews.index_at

    def index_at(self, step):
        rows.append((step, original(self, step)))
        return rows[-1][1]

    monkeypatch.setattr(TrainingViews, "index_at", index_at)
    return rows


class Listener(Silent):
    def __init__(self, interrupt_at=None):
        self.said, self.interrupt_at = [], interrupt_at

    def message(self, text):
        self.said.append(text)

    def log(self, record):
        if self.interrupt_at is not None and record.step >= self.interrupt_at:
            raise KeyboardInterrupt


def fit(monkeypatch, scene, run, judge, cfg=SMALL, **options):
    monkeypatch.setattr(automatic, "make_judge", lambda *args, **kwargs: judge)
    listener = options.pop("reporter", Listener())
    result = p2gs_jax.fit(scene, run, cfg, reporter=listener, **options)
    return result, [text for text in listener.said if "Growth ended" in text]


def test_a_few_views_are_picked_across_cameras_and_time():
    cameras = [c for c in "abc" for _ in range(8)]
    picks = pick_validation(cameras)
    assert picks == pick_validation(cameras)
    assert len(picks) == 2
    assert len({cameras[i] for i in picks}) == 2
    assert len({i % 8 for i in picks}) == 2
    many = pick_validation([c for c in "abc" for _ in range(100)])
    assert len(many) == 8
    assert {i // 100 for i in many} == {0, 1, 2}
    assert np.ptp([i % 100 for i in many]) > 80
    assert len(pick_validation([str(i) for i in range(9)])) == 2
    with pytest.raises(p2gs_jax.UserError, match="needs 8; this scene has 7"):
        pick_validation(["a"] * 7)


def test_views_left_out_come_back():
    views = TrainingViews(ImageStore((), SMALL.data), range(10), seed=0)
    before = [views.index_at(s) for s in range(30)]
    assert all(sorted(before[i : i + 10]) == list(range(10)) for i in (0, 10, 20))
    views.leave_out((2, 7))
    kept = sorted(set(range(10)) - {2, 7})
    assert all(sorted(views.index_at(8 * e + i) for i in range(8)) == kept for e in range(3))
    partners = {(views.index_at(s), views.partner_at(s, views.index_at(s))) for s in range(200)}
    assert {b for _, b in partners} == set(kept)
    assert all(a != b for a, b in partners)
    views.leave_out(())
    assert [views.index_at(s) for s in range(30)] == before


@pytest.mark.slow
def test_growth_ends_where_it_gains_nothing(monkeypatch, tmp_path, scene, taken):
    result, said = fit(monkeypatch, scene, tmp_path / "run", lambda params, population: 20.0)
    record = result.metrics["growth"]
    results, limit = record["looks"], record["limit"]
    assert len(results) == growth.PATIENCE
    # What gained nothing was taken back.
    assert limit == result.params.gaussians.capacity == results[0]["before"]
    assert all(stage["gaussians"] > 1.2 * stage["before"] for stage in results)
    assert [stage["gain"] for stage in results] == [0.0, 0.0]
    assert not any(stage["kept"] for stage in results)
    assert record == json.loads((tmp_path / "run" / "metrics.json").read_text())["growth"]
    assert len(said) == 1
    assert f"ended at {limit} Gaussians: the last stage" in said[0]
    assert "gained 0.00 dB on 2 held-out training views" in said[0]
    held_out = set(pick_validation(["0"] * 12))
    steps = {row: [s for s, r in taken if r == row] for row in range(12)}
    end = 100 * results[-1]["progress"]
    assert end < 50
    assert all(min(steps[row]) >= end for row in held_out)
    assert all(min(steps[row]) < end for row in set(range(12)) - held_out)


@pytest.mark.slow
def test_growth_goes_on_while_it_gains(monkeypatch, tmp_path, scene):
    result, said = fit(monkeypatch, scene, tmp_path / "run", population)
    results = result.metrics["growth"]["looks"]
    assert len(results) >= 2
    assert all(stage["kept"] for stage in results)
    assert [stage["before"] for stage in results[1:]] == [
        stage["gaussians"] for stage in results[:-1]
    ]
    assert result.params.gaussians.capacity == results[-1]["gaussians"] > 1.5 * results[0]["before"]
    assert results[-1]["progress"] <= SMALL.densify.stop
    assert "with its time or room" in said[0]


@pytest.mark.slow
def test_an_interrupted_run_grows_like_one_that_was_not(monkeypatch, tmp_path, scene):
    cfg = with_fields(SMALL, {"train.checkpoint_every_s": 0.0})
    whole, _ = fit(monkeypatch, scene, tmp_path / "whole", population, cfg)
    with pytest.raises(KeyboardInterrupt):
        fit(monkeypatch, scene, tmp_path / "cut", population, cfg, reporter=Listener(35))
    cut, _ = fit(monkeypatch, scene, tmp_path / "cut", population, cfg, resume=True)
    assert cut.metrics["growth"] == whole.metrics["growth"]
    for file in ("radiance.ply", "photometry.json"):
        assert (tmp_path / "cut" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


def test_the_host_remembers_growth_and_old_checkpoints_know_none():
    results = [StageResult(125, 21.0, 100, 20.8, 0.2), StageResult(150, 21.01, 125, 21.0, 0.3)]
    host = HostState(step=40, growth=Growth(results, 125))
    saved = json.loads(json.dumps(dataclasses.asdict(host)))
    assert HostState.from_dict(saved) == host
    assert [stage.kept for stage in HostState.from_dict(saved).growth.results] == [True, False]
    del saved["growth"]
    assert HostState.from_dict(saved) == HostState(step=40)


def test_stages_fill_the_time_and_stay_within_bounds():
    assert growth.upper_bound(1000, 1250) == 8000
    assert growth.upper_bound(1000, 9000) == 36000
    assert growth.upper_bound(900_000, 1_200_000) == 2_000_000
    assert growth.upper_bound(3_000_000, 3_750_000) == 3_000_000
    long = growth.plan_stage(1000, 8000, 10_000, 100)
    assert long is not None
    assert long.factor == pytest.approx(8 ** (1 / 9))
    assert long.events * 100 < growth.MOST_STEPS
    assert [long.target(done) for done in (1, 2, 3)] == [1260, 1260, 1260]
    short = growth.plan_stage(1000, 8000, 1.5 * growth.FEWEST_STEPS, 2)
    assert short is not None
    assert short.factor == growth.MOST_FACTOR
    assert short.target(1) < short.target(short.events // 2) == short.target(short.events) == 2000
    assert growth.plan_stage(1000, 8000, 0.9 * growth.FEWEST_STEPS, 20) is None
    assert growth.plan_stage(7000, 8000, 5000, 20) is None
    densify = SMALL.densify
    assert growth.window(densify, ((1.0, 1),)) == (growth.EARLIEST, 0.5)
    assert growth.window(densify, ((0.25, 4), (0.5, 2), (1.0, 1))) == (0.25, 0.5)


@pytest.mark.slow
def test_the_real_judge_measures_at_full_size(tmp_path, scene):
    result = p2gs_jax.fit(scene, tmp_path / "run", SMALL)
    results = result.metrics["growth"]["looks"]
    assert len(results) >= 2
    assert all(10 < stage[key] < 40 for stage in results for key in ("psnr", "without"))
    assert results[-1]["without"] > results[0]["without"]


@pytest.mark.parametrize("text", ["0", "-3", "many", "1.5", "1e5"])
def test_senseless_numbers(capsys, tmp_path, text):
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(tmp_path), "--out", str(tmp_path / "run"), f"--gaussians={text}"])
    assert stop.value.code == 2
    assert "whole number from 1 on, or auto" in capsys.readouterr().err


def test_auto_needs_mcmc_and_enough_views(capsys, tmp_path):
    scene, run = make_scene(tmp_path / "scene"), str(tmp_path / "run")
    for options, text in (
        (("--preset", "paper"), "--densify.method mcmc, not of adaptive"),
        (("--densify.method", "None"), "--densify.method mcmc, not of None"),
        ((), "needs 8; this scene has 5"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["fit", str(scene), "--out", run, "--gaussians", "auto", *options])
        assert stop.value.code == 2
        said = capsys.readouterr().err
        assert text in said
        assert "To fix it: give a number (--gaussians N)" in said


def test_sweeps_and_saved_configurations_know_auto():
    assert SMALL.densify.max_gaussians == "auto"
    assert from_dict(json.loads(json.dumps(to_dict(SMALL)))) == SMALL
    for value in (300, None):
        cfg = with_fields(SMALL, {"densify.max_gaussians": value})
        assert cfg.densify.max_gaussians == value
    for value in ("many", 1.5, True):
        with pytest.raises(p2gs_jax.UserError, match="takes int or 'auto' or"):
            with_fields(SMALL, {"densify.max_gaussians": value})
