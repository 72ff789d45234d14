"""A refused fit leaves its folder to the next command; memory is estimated before a fit."""

import dataclasses
import errno
import json
import shutil
from collections import Counter
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from jax.errors import JaxRuntimeError
from run.test_checkpoint import flip
from tiny_scene import contents, make_scene, prepared

import p2gs_jax
from p2gs_jax import DivergenceError, FitConfig, RenderConfig, UserError, with_fields
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.pipeline import calibrate, preflight
from p2gs_jax.pipeline import fit as pipeline
from p2gs_jax.pipeline.preflight import MemoryNeeded, check_run_dir, memory_needed, require_memory
from p2gs_jax.pipeline.survey import load
from p2gs_jax.render import selfcheck
from p2gs_jax.render.selfcheck import SelfCheck, suited
from p2gs_jax.run.checkpoint import CheckpointStore
from p2gs_jax.run.decisions import KEY, Decisions, kept_choice
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.write import write_start
from p2gs_jax.scene.files import recognition_key
from p2gs_jax.scene.pixels import cache, store


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("preflight") / "scene", views=4, points=60)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--preset", "paper", "--known-exposures", "KNOWN"), "draws initial exposures"),
        (("--preset", "ppisp", "--photometry.curve", "srgb"), "a whole camera"),
        (("--preset", "paper", "--photometry.curve", "spline"), "'spline' has no values"),
        (("--known-exposures", "KNOWN"), "names none of the"),
        (("--loss.regularizers.gamma-prior", "0.1"), "gamma-prior has no effect: exposures are"),
        (
            (
                "--loss.relative-exposure.weight",
                "1",
                "--loss.relative-exposure.form",
                "observed_ldr",
            ),
            "--loss.relative-exposure.weight has no effect",
        ),
        (
            ("--preset", "paper", "--photometry.model", "camera_exposure"),
            "the model camera_exposure needs solved exposures",
        ),
        (("--known-exposures", "exif"), "carries an exposure time"),
    ],
)
def test_a_refused_option_does_not_lock_the_folder(tmp_path, scene, refused, options, words):
    known = tmp_path / "known.csv"
    known.write_text("image,exposure\nelsewhere.png,1\n")
    run = tmp_path / "run"
    argv = [str(known) if o == "KNOWN" else o for o in options]
    text = refused("fit", scene, "--out", run, *argv)
    assert words in text
    assert "To fix it" in text
    assert not (run / "config.json").exists()
    check_run_dir(run, False, FitConfig())


@pytest.mark.parametrize("command", [p2gs_jax.fit, p2gs_jax.calibrate])
@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("data.max_width", 1, "--max-width must be at least 16"),
        ("data.max_frames", 1, "--max-frames must be at least 2"),
        ("data.every", 0, "--every must be at least 1"),
        ("train.batch", 0, "--train.batch must be at least 1"),
        ("train.budget_s", -1.0, "--budget must be longer than 0 s"),
        ("densify.max_gaussians", 0, "--gaussians must be at least 1"),
        ("photometry.known_deviation_ev", 0.1, "add --known-exposures FILE"),
        ("train.sh_every", 0.0, "--train.sh-every must be at least 1e-09"),
        (
            "train.coarse_to_fine",
            (0.5, 0.25),
            "--train.coarse-to-fine (0.5, 0.25) does not increase",
        ),
        ("dynamics.most_points", 0, "--dynamics.most-points must be at least 1"),
        ("init.opacity", 1.0, "--init.opacity must be at most 0.999999"),
        ("render.blur", -1.0, "--render.blur must be at least 0"),
        ("photometry.spline", (1.0, 2.0), "--photometry.spline has 2 values, and not 20"),
    ],
)
def test_functions_refuse_what_commands_refuse(tmp_path, scene, command, field, value, words):
    with pytest.raises(UserError) as refused:
        command(scene, tmp_path / "out", with_fields(FitConfig(), {field: value}))
    assert words in str(refused.value)


def test_known_exposures_and_calibrate_refuse_random_seeds(tmp_path, scene, monkeypatch):
    known = tmp_path / "known.csv"
    known.write_text("image,exposure\n000.png,1\n")
    cfg = with_fields(FitConfig(), {"photometry.known": str(known)})
    found = dataclasses.replace(load(scene, tmp_path, cfg), random_seeds=True)
    with pytest.raises(
        UserError, match="seed points are random, so --known-exposures give no radiance"
    ):
        prepared(found, cfg)
    monkeypatch.setattr(calibrate, "load_scene", lambda *_, **__: found)
    with pytest.raises(UserError, match="neither tracks nor points"):
        p2gs_jax.calibrate(scene, tmp_path / "out")


@pytest.mark.parametrize("change", ["photograph", "split", "camera"])
def test_a_run_is_not_continued_with_other_inputs(finished_run, tmp_path, refused, change):
    """Exposures that are kept by row would belong to other photographs."""
    run, scene = tmp_path / "run", tmp_path / "scene"
    shutil.copytree(finished_run, run)
    shutil.copytree(finished_run.parent / "scene", scene)
    saved = json.loads((run / "config.json").read_text()) | {"scene": str(scene)}
    (run / "config.json").write_text(json.dumps(saved))
    first, second = sorted((scene / "images").iterdir())[:2]
    if change == "photograph":
        shutil.copy(second, first)
    elif change == "split":
        (scene / "test.txt").write_text(first.name + "\n")
    else:
        model = scene / "sparse" / "0" / "cameras.txt"
        model.write_text(model.read_text().replace("90.0", "91.0"))
    files = contents(run)
    text = refused("fit", scene, "--out", run, *FIT, "--steps", "70", "--resume")
    assert "begun with other photographs" in text
    assert files == contents(run)


def test_a_run_is_recognised_by_the_content_of_its_known_exposures(tmp_path):
    listed = tmp_path / "known.csv"
    keys = [recognition_key((), None)]
    for value in ("0", "1", "0"):
        listed.write_text(f"image,ev\n1.png,{value}\n")
        keys.append(recognition_key((), str(listed)))
    assert keys[1] == keys[3]
    assert len(set(keys)) == 3


@pytest.mark.parametrize("checkpoint", [False, True])
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (DivergenceError("Step 1: no.", fix="lower the learning rates"), "Step 1: no."),
        (MemoryError(), "memory ran out"),
        (OSError(errno.ENOSPC, "No space left on device"), "No space left"),
        (JaxRuntimeError("RESOURCE_EXHAUSTED: 9 bytes\nat f"), "--gaussians"),
    ],
)
def test_a_failed_fit_keeps_its_folder_only_if_it_has_a_checkpoint(
    tmp_path, scene, refused, monkeypatch, error, words, checkpoint
):
    run = tmp_path / "run"
    start = SimpleNamespace(cfg=FitConfig(), decisions=Decisions.as_given(FitConfig()))

    def fail(self, start, write, **kwargs):
        write()
        if checkpoint:
            CheckpointStore(run / "checkpoints").save(3, {"a": np.zeros(2)}, {})
        raise error

    monkeypatch.setattr(pipeline, "survey", lambda *a, **k: SimpleNamespace(still=0, dense=0))
    monkeypatch.setattr(pipeline, "solve_exposures", lambda *a, **k: None)
    monkeypatch.setattr(pipeline, "initialise", lambda *a, **k: start)
    monkeypatch.setattr(pipeline.Optimiser, "expect", lambda *a, **k: None)
    monkeypatch.setattr(pipeline.Optimiser, "run", fail)
    assert words in refused("fit", scene, "--out", run)
    assert (run / "config.json").exists() == checkpoint
    if checkpoint:
        with pytest.raises(UserError, match="already holds a run"):
            check_run_dir(run, False, FitConfig())


def test_a_resumed_run_keeps_the_model_and_curve_of_its_checkpoints(tmp_path, scene, monkeypatch):
    run = tmp_path / "run"
    spline = (0.1, *np.random.default_rng(0).normal(size=19).tolist())
    chosen = {"photometry.model": "view_exposure", "photometry.curve": "spline"}
    chosen |= {"photometry.spline": list(spline)}
    fixed = Decisions.as_given(with_fields(FitConfig(), chosen))
    decided = dataclasses.replace(fixed, reasons=("Chosen: that.",))
    meta = {KEY: decided.to_dict()}
    CheckpointStore(run / "checkpoints").save(3, {"a": np.zeros(2)}, meta)
    solved = []

    def solve(scene, still, cfg, reporter, *, kept, **how):
        solved.append((cfg, kept))
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "solve_exposures", solve)
    monkeypatch.setattr(pipeline.Optimiser, "expect", lambda *a: None)
    for resume in (True, False):
        with pytest.raises(KeyboardInterrupt):
            p2gs_jax.fit(scene, run, FitConfig(), resume=resume)
    # The configuration stays as it is; decisions are passed beside it.
    assert solved == [(FitConfig(), decided), (FitConfig(), None)]
    photometry = decided.resolve(FitConfig()).photometry
    assert (photometry.curve, photometry.spline, photometry.select) == ("spline", spline, False)
    decided.require_same(meta[KEY], run)
    # A model that the user fixes, or that starts at random, was never chosen.
    for options in ({"photometry.select": False}, {"photometry.start": "random"}):
        cfg = with_fields(FitConfig(), options)
        assert kept_choice(cfg, RunFolder(run)) is None


def test_a_saved_choice_is_solved_again_and_its_reasons_are_repeated(tmp_path, scene):
    cfg = with_fields(FitConfig(), {"init.shell": "off", "init.dense": "off"})
    loaded = load(scene, tmp_path, cfg)
    first = prepared(loaded, cfg)
    assert first.selection is not None
    reasons = first.selection.reasons
    CheckpointStore(tmp_path / "checkpoints").save(
        3, {"a": np.zeros(2)}, {KEY: first.decisions.to_dict()}
    )
    kept = kept_choice(cfg, RunFolder(tmp_path))
    assert kept == first.decisions
    saved = first.decisions.to_dict()
    lacks = {k: v for k, v in saved.items() if k != "near"}
    for name, older, why in (
        ("lacks", lacks, "KeyError\\('near'\\)"),
        ("none", {**saved, "near": None}, "TypeError"),
    ):
        CheckpointStore(tmp_path / name / "checkpoints").save(3, {"a": np.zeros(2)}, {KEY: older})
        with pytest.raises(UserError, match=f"another version: {why}"):
            kept_choice(cfg, RunFolder(tmp_path / name))
    again = prepared(loaded, cfg, kept)
    assert again.selection is not None
    assert again.selection.reasons == reasons
    assert again.notes == first.notes
    assert again.selection.candidates == ()
    assert again.decisions == first.decisions
    solved = (first.selection.solution, again.selection.solution)
    np.testing.assert_array_equal(*(s.log_exposures for s in solved))
    np.testing.assert_array_equal(*(s.gammas for s in solved))


def test_masks_that_hide_everything_are_refused(tmp_path, refused):
    made = make_scene(tmp_path / "scene", views=4, points=60)
    (made / "masks").mkdir()
    for image in (made / "images").iterdir():
        height, width = cv2.imread(str(image)).shape[:2]
        cv2.imwrite(str(made / "masks" / image.name), np.zeros((height, width), np.uint8))
    text = refused("fit", made, "--out", tmp_path / "run")
    assert "the masks hide every pixel of all" in text
    assert "invert them" in text
    assert not (tmp_path / "run" / "config.json").exists()
    with pytest.raises(UserError, match="no point is visible in two photographs"):
        p2gs_jax.calibrate(made, tmp_path / "calibrated")


FIT = (
    *("--steps", "60", "--train.coarse-to-fine", "--test-every", "3"),
    *("--densify.max-gaussians", "400", "--render.sh-degree", "1", "--init.shell", "off"),
    *("--render.pixels-in-flight", "2048"),
)


def test_a_fit_from_files_is_that_from_memory(finished_run, tmp_path, succeeded, monkeypatch):
    """Like `finished_run` without a cache in memory; photographs are decoded once per size."""
    decoded = Counter()
    plain = store.decode

    def counted(view, sizes):
        decoded.update((view.name, size) for size in sizes)
        return plain(view, sizes)

    for place in (store, cache):  # the store, and the cache that decodes ahead
        monkeypatch.setattr(place, "decode", counted)
    run, scene = tmp_path / "run", finished_run.parent / "scene"
    succeeded("fit", scene, "--out", run, *FIT, "--data.cache-mb", "0")
    assert (run / "radiance.ply").read_bytes() == (finished_run / "radiance.ply").read_bytes()
    assert set(decoded.values()) == {1}
    assert not (run / "cache" / "pixels").exists()


def test_a_run_stays_as_it_is_if_its_checkpoints_cannot_be_read(finished_run, tmp_path, refused):
    run, scene = tmp_path / "run", finished_run.parent / "scene"
    shutil.copytree(finished_run, run)
    for path in run.glob("checkpoints/*/state.npz"):
        flip(path)
    files = contents(run)
    text = refused("fit", scene, "--out", run, *FIT, "--steps", "70", "--resume")
    assert "cannot be read" in text
    assert contents(run) == files


def test_a_finished_run_without_checkpoints_is_not_begun_anew(finished_run, tmp_path, refused):
    run, scene = tmp_path / "run", finished_run.parent / "scene"
    shutil.copytree(finished_run, run, ignore=shutil.ignore_patterns("checkpoints"))
    text = refused("fit", scene, "--out", run, *FIT, "--resume")
    assert f"{run}/checkpoints holds no readable checkpoint" in " ".join(text.split())
    # Neither is it cut into blocks.
    text = refused("fit", scene, "--out", run, *FIT, "--resume", "--blocks", "2")
    assert f"{run}/blocks/0/checkpoints holds no readable checkpoint" in " ".join(text.split())
    assert (run / "metrics.json").exists()


def test_a_full_disk_is_exit_2_before_anything_is_fitted(
    finished_run, tmp_path, refused, monkeypatch
):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=0))
    run, scene = tmp_path / "run", finished_run.parent / "scene"
    assert "--data.cache-mb" in refused("fit", scene, "--out", run, *FIT, "--data.cache-mb", "0")
    assert not (run / "config.json").exists()


def test_a_run_may_only_become_longer(tmp_path):
    fields = {"train.steps": 60, "train.budget_s": 60.0, "evaluation.lpips_weights": "alex"}
    cfg = with_fields(FitConfig(), fields)
    write_start(RunFolder(tmp_path), tmp_path, None, cfg, Decisions.as_given(cfg), ())
    for name, value in {"steps": 61, "budget_s": 90.0}.items():
        assert check_run_dir(tmp_path, True, with_fields(cfg, {f"train.{name}": value}))
    # Options of memory and of the evaluation may change.
    free = with_fields(cfg, {"data.cache_mb": 17, "evaluation.lpips_weights": None})
    assert not check_run_dir(tmp_path, True, free)
    wrong = {"train.steps": (60, 59), "train.budget_s": (60.0, 30.0), "train.seed": (0, 7)}
    wrong["densify.method"] = ("mcmc", "adaptive")
    for name, (before, now) in wrong.items():
        with pytest.raises(UserError, match=rf"options: {name} was {before}, now {now}\."):
            check_run_dir(tmp_path, True, with_fields(free, {name: now}))
    for before, now in ((60.0, None), (None, 60.0)):
        cfg = with_fields(cfg, {"train.budget_s": before})
        write_start(RunFolder(tmp_path), tmp_path, None, cfg, Decisions.as_given(cfg), ())
        with pytest.raises(UserError, match=r"train\.budget_s was"):
            check_run_dir(tmp_path, True, with_fields(cfg, {"train.budget_s": now}))
    path = RunFolder(tmp_path).config
    path.write_text(path.read_text().replace('"render": {', '"render": {"colour": true, '))
    with pytest.raises(UserError, match="unknown fields in RenderConfig: colour"):
        check_run_dir(tmp_path, True, cfg)


GB = 1e9
ROBUST = p2gs_jax.preset("robust")


@pytest.fixture
def left(monkeypatch):
    """Return a function that sets the free memory; the process holds 1 GB already."""
    monkeypatch.setattr(preflight, "resident", lambda: GB)

    def set_free(size):
        monkeypatch.setattr(preflight, "left_to_process", lambda: size)

    return set_free


def test_the_estimate_of_memory_counts_every_part(monkeypatch):
    monkeypatch.setattr(preflight, "size_at", lambda view, width: view.size)
    coverage = Coverage(500_000, 1.0)
    view = SimpleNamespace(width=1000, height=500, size=(1000, 500), name="a", image=None)

    def parts(cfg=None, views=4):
        cfg = with_fields(ROBUST, {"densify.max_gaussians": 50_000} | (cfg or {}))
        scene = SimpleNamespace(views=[view] * views, points=np.zeros((100, 3)))
        return memory_needed(scene, cfg, coverage)

    found = parts()
    assert found.population == 50_000
    assert found.total == sum(found[:4])
    assert parts({"densify.max_gaussians": 100_000}).gaussians == 2 * found.gaussians
    assert parts(views=8).photographs == 2 * found.photographs
    assert parts({"data.cache_mb": 1}).photographs == 2**20
    harmonics = parts({"render.sh_degree": 3}).gaussians / parts({"render.sh_degree": 0}).gaussians
    assert harmonics == (11 + 48) / (11 + 3)
    monkeypatch.setattr(preflight.jax, "default_backend", lambda: "gpu")
    on_gpu = parts()
    assert (on_gpu.gaussians, on_gpu.view) == (0, 0)
    assert on_gpu.photographs == found.photographs


def test_fits_beyond_the_memory_are_refused_with_options_that_save_memory(left):
    needed = MemoryNeeded(GB, 8 * GB, GB, GB, 4_000_000)
    for enough in (None, needed.total - GB):
        left(enough)
        require_memory(needed)
    left(3 * GB)
    words = r"about 11.0 GB .*4000000 Gaussians 8.0 GB.*and 4.0 GB is left"
    with pytest.raises(UserError, match=words) as error:
        require_memory(needed)
    assert all(o in error.value.fix for o in ("--gaussians", "--data.cache-mb", "--max-width"))


def test_a_fit_is_refused_before_its_exposures_are_solved(tmp_path, scene, left, refused):
    run = tmp_path / "run"
    left(0.1 * GB)
    assert "9000000 Gaussians" in refused("fit", scene, "--out", run, "--gaussians", 9_000_000)
    assert not (run / "config.json").exists()


@pytest.mark.parametrize("found", [SelfCheck(0.5, 0.0), SelfCheck(0.0, float("nan")), OSError("x")])
def test_a_kernel_that_fails_its_self_check_on_a_gpu_is_replaced(monkeypatch, found):
    assert suited(RenderConfig()) == (RenderConfig(), None)
    monkeypatch.setattr(selfcheck.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(selfcheck, "slow_here", lambda: None)
    monkeypatch.setattr(selfcheck, "self_check", lambda cfg: SelfCheck(1e-6, 1e-5))
    assert suited(RenderConfig()) == (RenderConfig(), None)
    monkeypatch.setattr(selfcheck, "self_check", Mock(side_effect=[found]))
    cfg, note = suited(RenderConfig())
    assert cfg.implementation == "xla"
    assert "failed its self-check" in note
