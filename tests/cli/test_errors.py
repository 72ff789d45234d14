"""Wrong input: one message that says what to do, exit code 2, never a traceback."""

import json
import shutil

import cv2
import numpy as np
import pytest

from p2gs_jax.cli.shared import parse_duration
from p2gs_jax.config import to_dict
from p2gs_jax.core.atomic import no_empty_folders
from p2gs_jax.errors import UserError
from p2gs_jax.pipeline.preflight import check_run_dir
from p2gs_jax.presets import preset


def images(folder, count=3, size=(40, 30)):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        cv2.imwrite(str(folder / f"{i:03d}.png"), np.full((*size[::-1], 3), 60 + i, np.uint8))


def transforms(root, frames=4, **extra):
    data = {"fl_x": 40, "fl_y": 40, "cx": 20, "cy": 15, "w": 40, "h": 30, "frames": []}
    for i in range(frames):
        pose = np.eye(4)
        pose[0, 3] = i
        data["frames"].append(
            {"file_path": f"images/{i:03d}.png", "transform_matrix": pose.tolist()}
        )
    (root / "transforms.json").write_text(json.dumps(data | extra))


def test_no_such_scene(run_command, tmp_path):
    code, text = run_command("fit", tmp_path / "nowhere", "--out", tmp_path / "run")
    assert code == 2
    assert "nowhere" in text


def test_empty_scene(run_command, tmp_path):
    (tmp_path / "scene").mkdir()
    code, text = run_command("fit", tmp_path / "scene", "--out", tmp_path / "run")
    assert code == 2
    assert "scene" in text


def test_missing_frames_are_listed(run_command, tmp_path):
    images(tmp_path / "images", 3)
    transforms(tmp_path, 5)
    code, text = run_command("fit", tmp_path, "--out", tmp_path / "run")
    assert code == 2
    assert "003.png" in text
    assert "--allow-missing" in text


def test_existing_run_is_not_overwritten(run_command, tmp_path):
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    (run_dir / "config.json").write_text("{}")
    code, text = run_command("fit", tmp_path, "--out", run_dir)
    assert code == 2
    assert "--resume" in text
    assert (run_dir / "config.json").read_text() == "{}"


@pytest.mark.parametrize(
    "option",
    [
        ("--budget", "soon"),
        ("--budget", "0s"),
        ("--steps", "0"),
        ("--max-width", "3"),
        ("--test-every", "-1"),
        ("--render.background", "0.1", "nan", "0.1"),
        ("--render.background", "0.1", "-0.1", "0.1"),
        ("--preset", "best"),
    ],
)
def test_senseless_options(run_command, tmp_path, option):
    code, text = run_command("fit", tmp_path, "--out", tmp_path / "run", *option)
    assert code == 2
    assert option[0] in text or "preset" in text


# What was written, and a word of the way on.
WRONG = [
    ("", "p2gs-jax COMMAND --help"),
    ("fitt castle", "did you mean fit?"),
    ("xyzzy", "`p2gs-jax --help` lists all commands"),
    ("--preset paper fit castle", "p2gs-jax COMMAND OPTIONS"),
    ("fit", "SCENE"),
    ("fit castle", "--out DIR"),
    ("fit castle --out run --bugdet 5m", "--budget"),
    ("fit castle --out run --rendr.tile 8 8", "--render.tile"),
    ("fit castle --out run --steps many", "'many' is not a whole number"),
    ("fit castle --out run --max-width 3.5", "'3.5' is not a whole number"),
    ("fit castle --out run --render.near close", "'close' is not a number"),
    ("fit castle --out run --render.tile 16", "Expected 2 values"),
    ("fit castle --out run --densify.method mcmcc", "'adaptive'"),
    ("fit castle --out run --gaussians few", "'few' is not a whole"),
    ("fit castle --out run --densify.spread 1", "for example 0.5"),
    ("fit castle --out run --preset bset", "choose paper, paper_appendix, robust"),
    ("fit castle --out run --preset", "--preset"),
    ("fit castle --out run --known-deviation-ev 0.1", "add --known-exposures FILE"),
    ("fit castle --out run --known-exposures none.csv", "none.csv cannot be read"),
    ("fit castle --out run --reference nowhere", "give --reference a folder"),
    ("fit castle --out run --lpips-weights none.npz", "docs/files.md"),
    ("fit castle --out file.txt", "name a folder with --out"),
    ("fit castle --out file.txt/run", "check that the path exists"),
    ("fit file.txt --out run", "name the folder of the scene"),
    ("fit nowhere --out run", "check the path of the scene"),
    ("fit junk --out run", "copy or export that photograph again"),
    ("calibrate castle --out run --compare-with none.csv", "none.csv cannot be read"),
    ("calibrate nowhere --out run --static", "name the folder of the photographs"),
    ("calibrate castle --out run --static", "several exposures"),
    ("fit castle --out run --iterations 100", "here it is called --steps"),
    ("fit castle --out run --sh_degree=2", "here it is called --render.sh-degree"),
    ("fit --source-path castle --out run", "p2gs-jax fit SCENE"),
    ("render castle --output x", "here it is called --out"),
    ("render castle --exposure-ev bright", "'bright' is not a number, and not own"),
    ("render castle", "p2gs-jax fit --out"),
    ("render", "RUN"),
    ("demo --budget 0", "write 90s, 5m or 1h30m"),
    ("demo --frames 0", "at least 1 frame"),
    ("synth file.txt", "name another folder"),
    ("synth new --layout village", "'street', 'town'"),
    ("sweep none.toml", "docs/sweeps.md"),
    ("sweep file.txt", "is not valid TOML"),
    ("doctor --jsn", "--json"),
    ("completion ksh", "'bash', 'zsh'"),
]


@pytest.mark.parametrize(("words", "way_on"), WRONG)
def test_wrong_words_are_answered_with_a_way_on(run_command, tmp_path, monkeypatch, words, way_on):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    images(tmp_path / "castle", 1)
    (tmp_path / "file.txt").write_text("a: [letter]")
    (tmp_path / "junk").mkdir()
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / "junk" / name).write_text("not a photograph")
    code, text = run_command(*words.split())
    assert code == 2
    assert way_on in text
    for folder in ("new", "run"):
        assert not (tmp_path / folder).exists(), "a failure leaves no empty folder"


def fail_in(path, *files):
    with no_empty_folders(path):
        (path / "cache").mkdir()
        for name in files:
            (path / name).write_text("what was done")
        raise RuntimeError


def test_folders_that_were_there_before_a_failure_stay(tmp_path):
    mine, new = tmp_path / "mine", tmp_path / "new" / "run"
    mine.mkdir()
    for path, files in ((mine, ()), (mine / "new" / "run", ()), (new, ("log",))):
        with pytest.raises(RuntimeError):
            fail_in(path, *files)
    assert list(mine.rglob("*")) == [mine / "cache"]
    assert [p.name for p in new.iterdir()] == ["log"]


@pytest.mark.parametrize("name", ["radiance.ply", "photometry.json"])
def test_a_damaged_run_is_named(run_command, tmp_path, finished_run, name):
    copy = shutil.copytree(finished_run, tmp_path / "run")
    (copy / name).write_bytes((copy / name).read_bytes()[:500])
    code, text = run_command("render", copy)
    assert code == 2
    assert name in text
    assert "restore it from a copy" in text
    assert "--resume" in text


@pytest.mark.parametrize("content", ["half", "object", "newer"])
def test_a_damaged_configuration_says_what_mends_it(run_command, tmp_path, finished_run, content):
    copy = shutil.copytree(finished_run, tmp_path / "run")
    path = copy / "config.json"
    saved = json.loads(path.read_text())
    saved["fit"]["render"]["colour"] = True
    path.write_text(
        {"half": path.read_text()[:300], "object": "{}", "newer": json.dumps(saved)}[content]
    )
    code, text = run_command("eval", copy)
    assert code == 2
    assert "config.json" in text
    assert ("with the version that made it" if content == "newer" else "--resume") in text
    if content == "half":
        code, text = run_command("fit", tmp_path, "--out", copy, "--resume")
        assert code == 2
        assert "remove it and repeat the options" in text


@pytest.mark.parametrize("command", ["render", "eval"])
def test_not_a_run_folder(run_command, tmp_path, command):
    code, text = run_command(command, tmp_path)
    assert code == 2
    assert "config.json" in text


def test_unfinished_run(run_command, tmp_path):
    (tmp_path / "config.json").write_text("{}")
    code, text = run_command("eval", tmp_path)
    assert code == 2
    assert "--resume" in text


def test_demo_does_not_overwrite_strangers(run_command, tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    code, text = run_command("demo", "--out", tmp_path)
    assert code == 2
    assert "other files" in text
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_resuming_under_other_options_is_refused(run_command, tmp_path):
    cfg = to_dict(preset("robust"))
    cfg["train"]["seed"] = 7
    (tmp_path / "config.json").write_text(json.dumps({"scene": "s", "fit": cfg}))
    code, text = run_command("fit", tmp_path, "--out", tmp_path, "--resume")
    assert code == 2
    assert "train.seed was 7, now 0" in text


def test_resuming_under_another_evaluation_is_allowed(tmp_path):
    cfg = to_dict(preset("robust"))
    for evaluation in (None, {"lpips_weights": "alex.npz"}):
        if evaluation is None:
            del cfg["evaluation"]  # as an older version wrote it
        else:
            cfg["evaluation"] = evaluation
        (tmp_path / "config.json").write_text(json.dumps({"scene": "s", "fit": cfg}))
        check_run_dir(tmp_path, True, preset("robust"))
    cfg["train"]["seed"] = 7
    (tmp_path / "config.json").write_text(json.dumps({"scene": "s", "fit": cfg}))
    with pytest.raises(UserError) as error:
        check_run_dir(tmp_path, True, preset("robust"))
    assert "train.seed" in str(error.value)
    assert "evaluation" not in str(error.value)


def test_a_run_of_an_older_version_goes_on(tmp_path):
    cfg = to_dict(preset("paper"))
    del cfg["render"]["deterministic"]
    del cfg["densify"]["method"]

    def write():
        (tmp_path / "config.json").write_text(json.dumps({"scene": "s", "fit": cfg}))

    write()
    with pytest.raises(UserError, match=r"densify.method was mcmc, now adaptive\."):
        check_run_dir(tmp_path, True, preset("paper"))
    cfg["densify"]["method"] = "adaptive"
    write()
    check_run_dir(tmp_path, True, preset("paper"))
    cfg["render"]["colour"] = True
    write()
    with pytest.raises(UserError, match=r"unknown field\(s\) in RenderConfig: colour"):
        check_run_dir(tmp_path, True, preset("paper"))


def test_durations():
    assert parse_duration("90") == parse_duration("90s") == 90
    assert parse_duration("5m") == 300
    assert parse_duration("1h30m") == 5400
    assert parse_duration("1m30s") == 90
    for text in ("", "m", "-5m", "5 minutes"):
        with pytest.raises(UserError):
            parse_duration(text)


def test_every_configuration_field_is_an_option(run_command):
    code, text = run_command("fit", "--help-all")
    assert code == 0
    for option in ("--loss.dssim-weight", "--densify.method", "--render.tile", "--train.log-every"):
        assert option in text
