"""Sweeps vary fields, keep finished runs, name failures and stop all runs together."""

import json
import os
import shutil
import signal
import threading
from pathlib import Path

import pytest
from tiny_scene import make_scene

import p2gs_jax
from p2gs_jax import UserError, grid, read_sweep, with_fields
from p2gs_jax.cli import main
from p2gs_jax.core import interrupts
from p2gs_jax.core.clock import whole_run
from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.jobs.job import REASON, JobFiles, read_job
from p2gs_jax.jobs.sweep import SweepResult, brief, failures, read_row, sweep, to_markdown
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.run.folder import RunFolder, locked
from p2gs_jax.run.photometry_files import read_photometry
from p2gs_jax.run.read import read_config
from p2gs_jax.run.write import write_start

BASE = p2gs_jax.preset("robust")
FIELDS = {"train.steps": 12, "train.coarse_to_fine": []}
SMALL = with_fields(BASE, FIELDS | {"densify.max_gaussians": 300, "render.sh_degree": 0})


def test_fields_are_replaced_by_their_dotted_names():
    fields = {"loss.relative_exposure.weight": 1, "photometry.select": False}
    cfg = with_fields(BASE, fields | {"train.coarse_to_fine": [0.5, 1], "data.max_width": None})
    assert cfg.loss.relative_exposure.weight == 1.0
    assert isinstance(cfg.loss.relative_exposure.weight, float)
    assert repr(cfg.train.coarse_to_fine) == "(0.5, 1.0)"
    assert not cfg.photometry.select
    assert cfg.optimizer == BASE.optimizer


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("loss.wieght", 1.0, "is not a configuration field"),
        ("train.steps.more", 1, "leave out the names"),
        ("train.steps", 1.5, "is not valid"),
        ("photometry.curve", "cubic", "'srgb'"),
        ("render.background", [1, "x", 0], r"write \[float, float, float\]"),
        ("photometry.select", 1, "is not valid"),
    ],
)
def test_wrong_fields_and_values_are_named(field, value, text):
    with pytest.raises(p2gs_jax.UserError, match=text):
        with_fields(BASE, {field: value})


def test_photographs_without_truth_do_not_count(tmp_path):
    scene, run = tmp_path / "scene", tmp_path / "run"
    for folder in (scene / "truth", run):
        folder.mkdir(parents=True)
    lines = ("image,exposure,iso", *(f"{k}.png,{2**k},1" for k in range(3)))
    (scene / "truth" / "exposures.csv").write_text("\n".join(lines))
    views = [{"image": f"{k}.png", "exposure": 3.0 * 2**k} for k in range(4)]
    (run / "photometry.json").write_text(json.dumps({"views": views}))
    (run / "metrics.json").write_text("{}")
    assert read_row(run, scene)["ev"] == pytest.approx(0, abs=1e-6)


def test_the_printed_table_is_short_and_the_file_explains_its_columns():
    row = {"name": "a", "seed": 0, "status": "done", "seconds": 56.2, "gaussians": 300}
    row |= {"train_psnr": 25.0, "train_lpips": 0.1, "test_psnr_fitted": 21.0, "ev": 0.01}
    rows = [row, {**row, "seed": 1, "status": "failed", "reason": "no seeds"}]
    rows.append({**row, "seed": 2, "train_psnr": 27.0})
    headings, lines = brief(rows)
    assert headings == [
        *("configuration", "seeds", "seconds", "Gaussians", "training PSNR dB"),
        *("held-out PSNR dB", "exposure error EV"),
    ]
    assert lines == [["a", "2 of 3", "56", "300", "26.00", "21.00", "0.0100"]]
    assert failures(rows) == ["a, seed 1: failed: no seeds"]
    text = to_markdown(rows)
    for column in ("seconds", "train_psnr", "test_psnr_fitted", "ev"):
        assert f"- `{column}`: " in text
    assert "ev_power" not in text
    assert "| a | 2 of 3 |" in text
    assert "no seeds" in text


@pytest.mark.parametrize(
    ("rows", "known"),
    [
        ("image,exposure\n{},1\n{},2\n", True),  # not of every photograph
        ("image,iso\n{},1\n", False),
        ("image,exposure\n{},bright\n{},2\n", False),
        ("image,exposure\n{}\n{},2\n", False),
    ],
)
def test_an_incomplete_truth_does_not_spoil_a_row(finished_run, tmp_path, rows, known):
    (tmp_path / "truth").mkdir()
    views = read_photometry(finished_run / "photometry.json")["views"]
    text = rows.format(*[v["image"] for v in views if v["split"] == "train"])
    (tmp_path / "truth" / "exposures.csv").write_text(text)
    row = read_row(finished_run, tmp_path)
    assert row["train_psnr"] > 0
    assert ("ev" in row) == known


def test_a_grid_has_every_combination():
    configs = grid(BASE, loss__relative_exposure__weight=[None, 0.1], render__sh_degree=[0, 1, 3])
    assert len(configs) == 6
    assert configs["weight 0.1, sh_degree 3"].loss.relative_exposure.weight == 0.1
    assert configs["weight None, sh_degree 0"].render.sh_degree == 0


def test_a_contradiction_of_options_ends_a_sweep_before_its_first_fit(tmp_path):
    scene = make_scene(tmp_path / "scene")
    bad = with_fields(p2gs_jax.preset("paper"), {"photometry.known": "exif"})
    with pytest.raises(p2gs_jax.UserError, match=r"bad: .*draws initial exposures"):
        sweep(scene, tmp_path / "out", {"good": SMALL, "bad": bad})
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_a_sweep_keeps_finished_runs_and_names_failures(tmp_path):
    scene = make_scene(tmp_path / "scene")
    configs = {
        "good": SMALL,
        "bad": with_fields(SMALL, {"photometry.known": "exif"}),
    }
    reports = []
    result = sweep(scene, tmp_path / "out", configs, seeds=[0, 1], report=reports.append)
    status = [(r["name"], r["seed"], r["status"]) for r in result.rows]
    assert status[:2] == [("good", 0, "done"), ("good", 1, "done")]
    assert status[2:] == [("bad", 0, "failed"), ("bad", 1, "failed")]
    good = result.rows[0]
    assert good["steps"] == 12
    assert good["train_psnr"] > 5
    metrics = json.loads((tmp_path / "out" / "good" / "seed_0" / "metrics.json").read_text())
    assert good["seconds"] == whole_run(metrics["seconds"]) > metrics["seconds"]["optimisation"]
    assert reports[0].endswith(f"{good['seconds']:.0f} s")
    assert "no photograph carries an exposure time" in result.rows[2]["reason"]
    assert json.loads((tmp_path / "out" / "sweep.json").read_text()) == result.rows
    table = (tmp_path / "out" / "sweep.md").read_text()
    assert "| good | 2 of 2 |" in table
    assert "bad, seed 0: failed" in table
    stamp = (tmp_path / "out" / "good" / "seed_0" / "metrics.json").stat().st_mtime_ns
    again = sweep(scene, tmp_path / "out", {"good": SMALL}, seeds=[0, 1], report=reports.append)
    assert [r["status"] for r in again.rows] == ["done", "done"]
    assert reports[-1].endswith("kept")
    assert (tmp_path / "out" / "good" / "seed_0" / "metrics.json").stat().st_mtime_ns == stamp
    other = {"good": with_fields(SMALL, {"train.steps": 11})}
    with pytest.raises(p2gs_jax.UserError, match="other options"):
        sweep(scene, tmp_path / "out", other)
    longer = {"good": with_fields(SMALL, {"train.steps": 18})}
    (row,) = sweep(scene, tmp_path / "out", longer).rows
    assert (row["status"], row["steps"]) == ("done", 18)
    twins = {"a b": SMALL, "a_b": SMALL}
    with pytest.raises(p2gs_jax.UserError, match="share the folder"):
        sweep(scene, tmp_path / "out", twins)


def test_a_file_describes_a_sweep(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(
        """
scene = "street"
reference = "street/reference"
seeds = [0, 3]
[set]
"train.steps" = 600
[grid]
"loss.relative_exposure.weight" = ["none", 0.01]
[[case]]
name = "paper"
preset = "paper"
"densify.max_gaussians" = 30000
"""
    )
    wanted = read_sweep(path)
    assert wanted.scene == tmp_path / "street"
    assert wanted.out == tmp_path / "s"
    assert wanted.reference == tmp_path / "street" / "reference"
    assert wanted.seeds == (0, 3)
    assert list(wanted.configs) == ["weight None", "weight 0.01", "paper"]
    assert wanted.configs["paper"].preset == "paper"
    assert all(cfg.train.steps == 600 for cfg in wanted.configs.values())
    assert wanted.configs["paper"].densify.max_gaussians == 30000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scene = ", "not valid TOML"),
        ("sceen = 'x'", "unknown key 'sceen'"),
        ("seeds = [1]", "does not name a scene"),
        ("scene = 'x'\nseeds = 3", "write whole numbers"),
        ("scene = 'x'\npreset = 'best'", "no preset 'best'"),
        ("scene = 'x'\n[grid]\n'train.stepz' = [1]", "is not a configuration field"),
        ("scene = 'x'\nseeds = [0, -1]", "use whole numbers from 0 on"),
        ("scene = 'x'\nseeds = [0, 1, 0]", "name every seed once"),
        ("scene = 'x'\nseeds = []", "at least one configuration and one seed"),
        ("scene = 'x'\n[[case]]\nname = 'a'\n[[case]]\nname = 'a'", "a different name"),
        ("scene = 5", "scene = 5 is not valid"),
        ("scene = 'x'\nset = 5", "write it as a table"),
        ("scene = 'x'\ngrid = []", "write it as a table"),
        ("scene = 'x'\n[grid]\n'photometry.curve' = 'srgb'", "is not a list"),
        ("scene = 'x'\n[grid]\ntrain.steps = [600]", "write the name in quotes"),
        ("scene = 'x'\n[case]\npreset = 'paper'", "write [[case]]"),
        ("scene = 'x'\nmax_parallel = true", "write a whole number"),
    ],
)
def test_wrong_sweep_files_are_refused_with_their_fault(tmp_path, refused, text, message):
    path = tmp_path / "s.toml"
    path.write_text(text)
    assert message in refused("sweep", path)


def test_progress_goes_to_stderr_and_names_stay_text(monkeypatch, capsys, tmp_path):
    def sweep(scene, out, configs, *, report, on_look, **more):
        report("half \x1b[31mdone")
        return SweepResult([{"name": "a", "seed": 0, "status": "done"}], out)

    monkeypatch.setattr("p2gs_jax.jobs.sweep.sweep", sweep)
    monkeypatch.setattr(
        "p2gs_jax.synth.write.write_street", lambda out, *, report, **_: report("half")
    )
    (tmp_path / "s.toml").write_text("scene = 'x'")
    for argv in (["sweep", str(tmp_path / "s.toml")], ["synth", str(tmp_path / "new")]):
        with pytest.raises(SystemExit) as code:
            main(argv)
        out, err = capsys.readouterr()
        assert code.value.code == 0
        assert "half" in err
        assert "half" not in out
        assert out
        assert "\x1b" not in out + err


CONFIGS = {name: p2gs_jax.preset("robust") for name in ("a", "b", "c")}


def runner(work):
    """Return an engine's function of a job, which calls `work` with its folder and stop file."""

    def run(job_path):
        files = JobFiles(Path(job_path))
        return work(read_job(files.path).folder, files.stop)

    return run


def finished(run, stop):
    run.mkdir(parents=True, exist_ok=True)
    (run / "metrics.json").write_text('{"counts": {"gaussians": 5}, "seconds": {}}')
    (run / "photometry.json").write_text('{"views": []}')
    return "done", None


def test_a_signal_leaves_a_table_and_the_same_sweep_goes_on(tmp_path):
    started = threading.Event()

    def work(run, stop):
        if stop.exists():
            return "stopped", None
        if run.parent.name == "b":
            # Runs that the engine does not have yet would be waiting, not interrupted.
            assert started.wait(60)
            os.kill(os.getpid(), signal.SIGTERM)
            while not stop.exists():
                pass
            return "stopped", None
        return finished(run, stop)

    with pytest.raises(Interrupted), interrupts.raised():
        sweep("scene", tmp_path, CONFIGS, on_look=lambda states: started.set(), run=runner(work))
    rows = json.loads((tmp_path / "sweep.json").read_text())
    assert [row["status"] for row in rows] == ["done", "interrupted", "interrupted"]
    assert not list(tmp_path.rglob(REASON))
    rows = sweep("scene", tmp_path, CONFIGS, run=runner(finished)).rows
    assert [row["status"] for row in rows] == ["done"] * 3


def test_a_continuation_that_fails_does_not_count_as_done(tmp_path):
    sweep("scene", tmp_path, {"a": BASE}, run=runner(finished))
    cfg = with_fields(BASE, {"train.steps": BASE.train.steps + 1})
    folder = tmp_path / "a" / "seed_0"
    write_start(RunFolder(folder), tmp_path, None, BASE, Decisions.as_given(BASE), ())
    failing = runner(lambda run, stop: ("failed", "no scene"))
    (row,) = sweep(tmp_path, tmp_path, {"a": cfg}, run=failing).rows
    assert (row["status"], row["reason"]) == ("failed", "no scene")
    for scene, reference in ((folder, None), (tmp_path, folder)):
        with pytest.raises(UserError, match=r"was begun with the (scene|reference) "):
            sweep(scene, tmp_path, {"a": BASE}, reference=reference, run=runner(finished))


def test_a_run_with_broken_files_fails_alone(tmp_path):
    def work(run, stop):
        ended = finished(run, stop)
        if run.parent.name == "b":
            (run / "metrics.json").write_text("[]")
        return ended

    rows = sweep("scene", tmp_path, CONFIGS, max_parallel=3, run=runner(work)).rows
    assert [row["status"] for row in rows] == ["done", "failed", "done"]
    assert "its files cannot be read" in rows[1]["reason"]


def test_finished_runs_are_kept_under_the_same_evaluation_and_photographs(finished_run, tmp_path):
    scene, out = tmp_path / "scene", tmp_path / "out"
    folder = shutil.copytree(finished_run, out / "a" / "seed_0")
    shutil.copytree(finished_run.parent / "scene", scene)
    saved = json.loads((folder / "config.json").read_text()) | {"scene": str(scene)}
    (folder / "config.json").write_text(json.dumps(saved))
    cfg = read_config(folder / "config.json")[1]
    again = runner(lambda run, stop: ("failed", "evaluated again"))
    (row,) = sweep(scene, out, {"a": cfg}, run=again).rows
    assert row["status"] == "done"
    first, second = sorted((scene / "images").iterdir())[:2]
    shutil.copy(second, first)
    with pytest.raises(UserError, match=r"a: .* was begun with other photographs"):
        sweep(scene, out, {"a": cfg}, run=again)
    shutil.copy(finished_run.parent / "scene" / "images" / first.name, first)
    saved["fit"]["evaluation"]["lpips_weights"] = "alex"
    (folder / "config.json").write_text(json.dumps(saved))
    (row,) = sweep(scene, out, {"a": cfg}, run=again).rows
    assert (row["status"], row["reason"]) == ("failed", "evaluated again")


def test_two_sweeps_do_not_share_a_folder(tmp_path):
    with locked(tmp_path), pytest.raises(UserError, match=f"process {os.getpid()}"):
        sweep("scene", tmp_path, CONFIGS)
