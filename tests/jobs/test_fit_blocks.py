"""A scene in two blocks is a run like any other, with exposures solved for all blocks."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_cut import make_road
from tiny_scene import make_scene

import p2gs_jax
from p2gs_jax import UserError, with_fields
from p2gs_jax.core.atomic import plain
from p2gs_jax.core.progress import Silent
from p2gs_jax.gaussians.dense import coverage_of
from p2gs_jax.gaussians.population import default_max_gaussians
from p2gs_jax.jobs.blocks import fit as module
from p2gs_jax.jobs.blocks import plan as room
from p2gs_jax.jobs.blocks.block import block_config
from p2gs_jax.jobs.blocks.cut import cut_scene
from p2gs_jax.jobs.blocks.plan import check_options, read_plan, write_plan
from p2gs_jax.jobs.blocks.shared import read_shared, solve_shared
from p2gs_jax.jobs.job import JobState
from p2gs_jax.pipeline.survey import load
from p2gs_jax.scene.pixels.store import ImageStore

FIELDS = {"train.steps": 20, "train.coarse_to_fine": [], "data.test_every": 4}
FIELDS |= {"densify.max_gaussians": 400, "init.dense": "off", "init.shell": "off"}
FIELDS |= {"render.sh_degree": 0, "render.pixels_in_flight": 2048}
SMALL = with_fields(p2gs_jax.preset("robust"), FIELDS)


@pytest.fixture
def in_this_process(monkeypatch):
    """Run blocks in turn; return a list of the started ones, and a set for those that fail."""
    started, fail = [], set()

    def run_jobs(jobs, engine, folder, *, on_end, on_look):
        states = []
        for number, job in enumerate(jobs):
            started.append(job.name)
            state = JobState(job.name, "done")
            if job.name in fail:
                state = JobState(job.name, "failed", reason="the disk is full")
            else:
                job.task(job.folder, json.loads(json.dumps(plain(job.arguments))), Silent())
            on_end(number, state)
            states.append(state)
        return states

    monkeypatch.setattr(module, "run_jobs", run_jobs)
    return started, fail


@pytest.mark.slow
def test_two_blocks_become_one_run(tmp_path, in_this_process):
    started, fail = in_this_process
    scene, run = make_scene(tmp_path / "scene", views=8), tmp_path / "run"
    fail.add("block 1")
    with pytest.raises(UserError, match=r"1 of 2 blocks failed\. block 1: the disk is full"):
        p2gs_jax.fit_blocks(scene, run, SMALL, blocks=2)
    with pytest.raises(UserError, match="started with --blocks 2"):
        p2gs_jax.fit_blocks(scene, run, SMALL, blocks=3, resume=True)
    fail.clear()
    result = p2gs_jax.fit_blocks(scene, run, SMALL, blocks=2, resume=True)
    # A finished block is kept.
    assert started == ["block 0", "block 1", "block 1"]
    saved = json.loads((run / "metrics.json").read_text())
    blocks = saved["districts"]["blocks"]
    assert [b["views"] <= 6 for b in blocks] == [True, True]
    assert sum(b["gaussians_in_core"] for b in blocks) == saved["counts"]["gaussians"]
    (seam,) = saved["districts"]["seams"]
    assert seam["blocks"] == [0, 1]
    assert p2gs_jax.load_run(run).params.gaussians.capacity == saved["counts"]["gaussians"]
    # The exposures are those of the bundle adjustment; blocks do not change them.
    shared = read_shared(run / "blocks", load(scene, run, SMALL), SMALL)
    solved = shared.exposures.photometry.exposures
    np.testing.assert_allclose(
        np.asarray(result.params.photometry.exposures), solved / np.exp(np.log(solved).mean()), 1e-5
    )
    assert saved["test"]["exposure_fitted"]["psnr"] > 15
    took = [json.loads((run / f"blocks/{k}/metrics.json").read_text())["seconds"] for k in (0, 1)]
    assert saved["seconds"]["optimisation"] == pytest.approx(sum(s["optimisation"] for s in took))
    assert saved["seconds_per_step"] == saved["seconds"]["optimisation"] / saved["counts"]["steps"]
    # More steps continue every block.
    longer = with_fields(SMALL, {"train.steps": 30})
    again = p2gs_jax.fit_blocks(scene, run, longer, blocks=2, resume=True).metrics
    assert started[3:] == ["block 0", "block 1"]
    assert again["counts"]["steps"] == pytest.approx(1.5 * saved["counts"]["steps"], abs=1)


def test_one_block_is_an_ordinary_fit(tmp_path, monkeypatch):
    call = {}

    def fit(scene, run, cfg, **options):
        call.update(options, cfg=cfg)
        return "fitted"

    monkeypatch.setattr(module, "fit", fit)
    scene = make_scene(tmp_path / "scene")
    assert p2gs_jax.fit_blocks(scene, tmp_path / "run", SMALL, blocks="auto") == "fitted"
    assert call["cfg"] == SMALL
    assert not (tmp_path / "run" / "blocks").exists()
    scene = replace(load(scene, tmp_path / "run", SMALL), random_seeds=True)
    with pytest.raises(UserError, match="seed points are random, so the exposures"):
        solve_shared(scene, ImageStore(scene.views, SMALL.data), SMALL, Silent(), None)


def test_a_block_may_have_more_gaussians_if_points_lie_outside():
    scene = make_road(points=20_000)
    whole = with_fields(SMALL, {"densify.max_gaussians": None, "train.steps": 600})
    cut, count, views = cut_scene(scene, 4), len(scene.points), len(scene.train_indices)

    def most(inside, **densify):
        cfg = with_fields(whole, {f"densify.{name}": value for name, value in densify.items()})
        return block_config(cfg, cut, 0, scene, inside, train_views=views).densify.max_gaussians

    coverage = coverage_of(scene, whole.data.max_width)
    assert most(count) == default_max_gaussians(count, coverage, whole.train)
    assert most(count // 2) > most(count)
    share = len(cut.blocks[0].views) / views
    assert (
        most(count, max_gaussians=1000)
        == most(count // 2, max_gaussians=1000)
        == round(1000 * share)
    )
    assert most(count, method="adaptive") is None


def test_blocks_that_exceed_the_memory_are_refused_with_a_number_that_fits(monkeypatch):
    scene = make_road()
    four = room.largest_block(scene, SMALL, cut_scene(scene, 4))
    assert four < room.bytes_needed(scene, SMALL)
    # There is room for a quarter of the scene, and not for a half.
    monkeypatch.setattr(room, "left_to_process", lambda: four * 1.00001)
    count = room.fewest_blocks(scene, SMALL, 1)
    assert count in (3, 4)
    assert room.largest_block(scene, SMALL, cut_scene(scene, count)) <= four * 1.00001
    room.require_room(scene, SMALL, cut_scene(scene, 4), 1)
    with pytest.raises(UserError, match=f"--blocks {count}"):
        room.require_room(scene, SMALL, cut_scene(scene, 2), 1)
    with pytest.raises(UserError, match="2 at a time"):
        room.require_room(scene, SMALL, cut_scene(scene, 4), 2)
    monkeypatch.setattr(room, "left_to_process", lambda: 1e6)
    with pytest.raises(UserError, match="even the smallest blocks"):
        room.fewest_blocks(scene, SMALL, 1)
    monkeypatch.setattr(room, "left_to_process", lambda: None)
    assert room.fewest_blocks(scene, SMALL, 1) == 1


@pytest.mark.parametrize(
    ("cfg", "words"),
    [
        (p2gs_jax.preset("3dgs"), "'3dgs' learns them"),
        (p2gs_jax.preset("paper"), "learns them"),
        (with_fields(SMALL, {"loss.relative_exposure.weight": 0.1}), "cannot change them"),
        (with_fields(SMALL, {"dynamics.method": "vibration"}), "static scenes only"),
    ],
)
def test_options_that_blocks_cannot_share_are_refused(cfg, words):
    with pytest.raises(UserError, match=words):
        check_options(cfg)


def test_a_broken_plan_is_named(tmp_path):
    assert read_plan(tmp_path, "2") is None
    (tmp_path / "plan.json").write_text('{"asked": "2"}')
    with pytest.raises(UserError, match=r"plan\.json cannot be read"):
        read_plan(tmp_path, "2")


def test_a_plan_is_kept_for_auto_and_for_its_number(tmp_path):
    cut = cut_scene(load(make_scene(tmp_path / "scene", views=12), tmp_path, SMALL), 3)
    write_plan(tmp_path, cut, "auto")
    for blocks in ("auto", "3"):
        assert read_plan(tmp_path, blocks).blocks == cut.blocks
