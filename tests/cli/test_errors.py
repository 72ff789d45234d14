"""Wrong input: one message that says what to do, exit code 2, never a traceback."""

import errno
import json
import shlex
import shutil
import signal

import cv2
import numpy as np
import pytest
from tiny_scene import contents

from p2gs_jax.cli.experiments import Synth
from p2gs_jax.cli.shared import has_viewer, parse_duration
from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.errors import UserError
from p2gs_jax.presets import preset, to_dict
from p2gs_jax.run.folder import locked

EMPTY = "is empty. To fix it: name a file or folder, or write . for the current folder"
# Command lines, and a part of the remedy that the error names.
WRONG = [
    ("", "p2gs-jax COMMAND --help"),
    ("fitt castle", "did you mean fit?"),
    ("xyzzy", "`p2gs-jax --help` lists all commands"),
    ("--preset paper fit castle", "p2gs-jax COMMAND OPTIONS"),
    ("fit", "SCENE"),
    ("fit castle --resume", "name the run with --out"),
    ("train.py -s castle -m run", "p2gs-jax fit SCENE"),
    ("simple_trainer.py mcmc --data-dir castle", "p2gs-jax fit SCENE"),
    ("fit -s castle", "p2gs-jax fit SCENE"),
    ("fit castle -m run", "--out"),
    ("fit castle --out run --bugdet 5m", "--budget"),
    ("fit castle --out run --budget soon", "write 90s, 5m or 1h30m"),
    ("fit castle --out run --budget 0s", "longer than 0 s"),
    ("fit castle --out run --rendr.tile 8 8", "--render.tile"),
    ("fit castle --out run --steps many", "'many' is not a whole number"),
    ("fit castle --out run --steps 0", "--steps must be"),
    ("fit castle --out run --photometry.curve power", "add --photometry.no-select"),
    ("calibrate castle --out run --photometry.white-balance view", "add --photometry.no-select"),
    ("fit nowhere --out run --test-every 1", "--test-every"),
    ("fit nowhere --out run --split none.txt", "correct the option --split"),
    ("fit nowhere --out run --split castle/000.png --test-every 0", "leave out one of them"),
    ("fit nowhere --out run --background puce", "--background 0.5,0.5,0.5"),
    ("fit castle --out run --seed -1", "--seed must be at least 0"),
    ("fit castle --out run --train.log-every 0", "--train.log-every must be at least 1"),
    ("fit castle --out run --render.tile 0 8", "--render.tile must be at least 1"),
    ("fit castle --out run --render.sh-degree 9", "--render.sh-degree must be at most 3"),
    ("fit castle --out run --optimizer.means nan", "--optimizer.means nan is not a finite number"),
    ("fit castle --out run --data.max-width 3", "--max-width must be at least 16"),
    ("fit castle --out run --render.near close", "'close' is not a number"),
    ("fit castle --out run --render.tile 16", "Expected 2 values"),
    ("fit castle --out run --render.background 0.1 nan 0.1", "--render.background"),
    ("fit castle --out run --densify.method mcmcc", "'adaptive'"),
    *[
        (f"fit castle --out run --preset paper --photometry.{option}", "--photometry.start tracks")
        for option in ("vignetting camera", "responses camera", "white-balance camera")
    ],
    (
        "fit castle --out run --preset ppisp_solved --photometry.start random "
        "--photometry.curve srgb",
        "or --photometry.vignetting None --photometry.responses all",
    ),
    (
        "fit castle --out run --known-exposures file.txt --photometry.parameterization linear",
        "add --photometry.parameterization log",
    ),
    ("fit castle --out run --densify.spread 1", "for example 0.5"),
    ("fit castle --out run --preset bset", "choose paper, paper_appendix, robust"),
    ("fit castle --out run --blocks some", "'some' is not a whole number, and not auto"),
    ("fit castle --out run --blocks 0", "a whole number from 1 on, or auto"),
    ("fit castle --out run --blocks 2 --jobs 0", "--jobs must be at least 1"),
    ("fit castle --out run --blocks 2 --devices 2", "on one device"),
    ("fit castle --out run --blocks 2 --threads 2", "leave out --devices and --threads"),
    *[("fit castle --out run --view --blocks 2", "RUN/blocks/0")] * has_viewer(),
    ("fit castle --out run --port 9000", "without --view"),
    ("fit castle --out run --threads 0", "--threads 0 is not a number of cores"),
    ("fit castle --out run --blocks 2 --engine ray", "'ray' is not a known engine"),
    ("fit castle --out run --blocks 2 --preset 3dgs", "learns them"),
    ("fit castle --out run --jobs 2", "add --blocks auto, or a number"),
    ("fit castle --out run --preset 3dgs --photometry.start tracks", "splats display values"),
    ("fit castle --out run --devices 0", "from 1 on, or all"),
    ("fit castle --out run --devices two", "two"),
    ("fit castle --out run --exposure-sigma 0.1", "add --known-exposures FILE"),
    ("fit castle --out run --known-exposures none.csv", "none.csv cannot be read"),
    ("fit castle --out run --reference nowhere", "give --reference a folder"),
    ("fit castle --out run --lpips-weights none", "choose alex or vgg"),
    ("fit castle --out file.txt", "name a folder with --out"),
    ("fit castle --out file.txt/run", "check that the path exists"),
    ("fit castle --out begun", "--resume"),
    ("fit castle --out other --resume", "train.seed was 7, now 0"),
    ("fit castle --out torn --resume", "remove it and repeat the"),
    ("fit file.txt --out run", "file.txt is neither a transforms.json nor a video."),
    ("inspect file.txt", "name the folder of the scene"),
    ("fit nowhere --out run", "nowhere does not exist. To fix it: check the path of the scene"),
    ("fit empty --out run", "no scene in empty: there is no COLMAP model"),
    ("calibrate empty --out run", "no transforms.json or transforms_train.json"),
    ("inspect empty", "and no photographs (looked in empty/images, empty)."),
    ("fit junk --out run", "copy or export that photograph again"),
    ("fit gaps --out run", "--data.allow-missing"),
    ("calibrate gaps --out run", "--data.allow-missing"),
    ("fit castle --out run --frames 0:4", "is not a drive, which --data.frames is for"),
    ("fit castle --out run --every 5", "is not a video, which --data.every is for"),
    ("inspect gaps --data.matching all", "which --data.matching is for"),
    ("inspect castle --data.format colmap", "leave out --data.format"),
    ("sweep empty", "name a TOML file"),
    ("calibrate nowhere --out run --static", "name the folder of the photographs"),
    ("calibrate castle --out run --static --develop 8bit", "--static"),
    ("calibrate castle --out run --static --preset paper", "--preset has no effect with --static"),
    ("calibrate castle --out run --exposure-ev 1", "without --develop"),
    ("calibrate castle --out run --no-masks", "without --develop"),
    ("calibrate castle --out run --static", "several exposures"),
    ("calibrate castle --out file.txt", "file.txt is a file. To fix it: name a folder with"),
    ("sweep sweep.toml --out file.txt", "file.txt is a file. To fix it: name a folder with"),
    ("demo --out file.txt", "file.txt is a file. To fix it: name a folder with"),
    ("calibrate castle --out begun", "photometry.json would be replaced"),
    ("calibrate castle --out begun --static", "photometry.json would be replaced"),
    (
        "calibrate castle --out run --static --photometry.curve power",
        "leave out --photometry.curve",
    ),
    ("calibrate castle --out run --static --data.max-width 99", "leave out --data.max-width"),
    ("calibrate castle --out run --static --photometry.pivot 1", "leave out --photometry.pivot"),
    ("calibrate castle --out run --data.test-every 3", "--data.test-every, which would have no"),
    ("calibrate castle --out run --data.max-width 99", "leave out --data.max-width"),
    ("calibrate castle --out run --max-width 99", "--max-width"),
    ("calibrate castle --out run --densify.method mcmc", "--densify.method"),
    ("fit castle --out run --iterations 100", "here it is called --steps"),
    ("fit castle --out run --sh_degree=2", "here it is called --render.sh-degree"),
    ("fit --source-path castle --out run", "p2gs-jax fit SCENE"),
    ("render castle --exposure-ev bright", "'bright' is not a number, and not own"),
    ("render castle", "p2gs-jax fit --out"),
    ("eval castle", "config.json"),
    ("eval torn", "--resume"),
    ("demo --frames 0", "at least 1 frame"),
    ("demo --out castle", "other files"),
    ("demo --out done", "holds a finished demo"),
    ("synth file.txt", "name another folder"),
    ("synth new --seed -1", "use a seed of 0 or more"),
    ("synth new --frames 1 --sensor.drift-ev nan", "drift-ev is nan, but must be from 0 to 10"),
    ("synth new --frames 1 --sensor.white-balance-ev inf", "--sensor.white-balance-ev is inf"),
    ("synth new --frames 1 --sensor.compensation-ev 1e9", "but must be from -20 to 20"),
    ("synth new --frames 1 --sensor.vignetting 2", "but must be from 0 to 0.8"),
    ("synth new --frames 1 --sensor.noise -1", "--sensor.noise is -1.0, but must be from 0"),
    ("synth new --frames 1 --sensor.camera-gain-ev -1", "--sensor.camera-gain-ev is -1.0"),
    ("compare", "to compare"),
    ("compare castle", "to compare"),
    ("sweep none.toml", "docs/api.md"),
    ("sweep file.txt", "is not valid TOML"),
    ("doctor --skip-selftest", "--skip-self-test"),
    ("render fitted --trajectory spiral", "--trajectory"),
    ("render fitted --trajectory nowhere.json", "nowhere.json"),
    ("render fitted --curve spline", "spline"),
    ("render fitted --curve film", "film"),
    ("render fitted --gamma 0", "--gamma"),
    ("render fitted --exposure-ev 5000", "--exposure-ev"),
    ("render fitted --exposure-ev own --trajectory orbit", "own"),
    ("render fitted --meter auto --exposure-ev own", "--meter"),
    ("render fitted --meter best", "--meter"),
    ("render fitted --without-objects --only-objects", "--without-objects"),
    ("render fitted --without-objects", "no moving object"),
    ("render fitted --no-vignetting", "no vignetting"),
    ("render fitted --panorama", "one camera"),
    ("render fitted --panorama --trajectory orbit", "--panorama"),
    ("render fitted --camera front", "'front'"),
    ("render fitted --frames 9", "--frames"),
    ("render fitted --frames 1 --trajectory drive", "--frames"),
    ("render fitted --shift 999 --trajectory drive", "--shift"),
    ("render fitted --width 3", "--width"),
    ("render fitted --fps 24", "--fps"),
    ("render fitted --out film.mov", "film.mov"),
    ("render fitted --split best", "--split"),
    ("export fitted --format obj", "obj"),
    ("export fitted", "format"),
    ("export fitted --format gltf --exposure-ev bright", "exposure-ev"),
    ("export fitted --format gltf --exposure-ev 99", "--exposure-ev"),
    ("export fitted --format gltf --gamma 0", "--gamma"),
    ("export fitted --format gltf --bake-steps -1", "--bake-steps"),
    ("export fitted --format gltf --curve spline", "no spline"),
    ("export fitted --format gltf --curve wavy", "wavy"),
    ("export fitted --format exr colmap --gamma 2", "--gamma has no effect"),
    ("export fitted --format exr --size-mb 2", "--size-mb has no effect"),
    ("export fitted --format html --size-mb 0", "--size-mb"),
    ("export fitted --format html --photographs -1", "--photographs"),
    ("export fitted --format html --bake-steps 3", "--bake-steps"),
    ("export fitted --format exr --photographs 3", "--photographs"),
    ("export fitted --format exr --without-objects", "no moving object"),
    ("inspect ''", EMPTY),
    ("calibrate '' --out run", EMPTY),
    ("fit castle --out ''", EMPTY),
    ("fit castle --out=''", EMPTY),
    *[
        ("view castle --port 0", "config.json"),
        ("view castle --port 70000", "--port"),
        ("view castle --port 0 --host no.such.host.invalid", "--host"),
        ("view castle --port 0 --max-width 3", "--max-width"),
    ]
    * has_viewer(),
]


def test_a_demo_is_not_replaced_while_it_runs(tmp_path, run_command):
    (tmp_path / "street").mkdir()
    (tmp_path / "demo.json").touch()
    for running in (tmp_path, tmp_path / "run"):
        running.mkdir(exist_ok=True)
        with locked(running):
            code, text = run_command("demo", "--out", tmp_path)
        assert (code, "is being written to by process" in text) == (2, True)
        assert (tmp_path / "street").is_dir()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, finished_run):
    """Return a folder with the scenes, runs and files that WRONG names, each with its fault."""
    root = tmp_path_factory.mktemp("wrong")
    shutil.copytree(finished_run, root / "fitted")
    for name in ("castle", "junk", "empty", "begun", "other", "torn", "gaps/images", "done/run"):
        (root / name).mkdir(parents=True)
    for name in ("demo.json", "run/metrics.json"):
        (root / "done" / name).touch()
    for name in ("castle", "gaps/images"):
        cv2.imwrite(str(root / name / "000.png"), np.full((30, 40, 3), 60, np.uint8))
    pose = {"transform_matrix": np.eye(4).tolist()}
    frames = [{"file_path": f"images/{k:03d}.png", **pose} for k in range(2)]
    shape = {"fl_x": 40, "fl_y": 40, "cx": 20, "cy": 15, "w": 40, "h": 30}
    (root / "gaps" / "transforms.json").write_text(json.dumps(shape | {"frames": frames}))
    for name in ("a.jpg", "b.jpg"):
        (root / "junk" / name).write_text("not a photograph")
    (root / "file.txt").write_text("a: [letter]")
    (root / "sweep.toml").write_text("scene = 'castle'")
    (root / "begun" / "config.json").write_text("{}")
    (root / "torn" / "config.json").write_text('{"scene": "s", "fi')
    cfg = to_dict(preset("robust"))
    cfg["train"]["seed"] = 7
    (root / "other" / "config.json").write_text(json.dumps({"scene": "s", "fit": cfg}))
    return root


@pytest.mark.parametrize(("words", "remedy"), WRONG)
def test_wrong_command_lines_end_with_a_remedy(refused, folder, monkeypatch, words, remedy):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "100")
    before = contents(folder)
    text = " ".join(refused(*shlex.split(words)).split())
    assert remedy in text
    assert "Run folder" not in text
    assert contents(folder) == before, "a failure leaves everything as it was"


@pytest.mark.parametrize(
    ("name", "content", "remedy"),
    [
        ("radiance.ply", 500, "restore it from a copy"),
        ("photometry.json", 500, "restore it from a copy"),
        ("scene.npz", 300, "fit again"),
        ("config.json", 300, "--resume"),
        ("config.json", "{}", "--resume"),
        ("config.json", "newer", "with the version that made it"),
    ],
)
def test_damaged_runs_end_with_a_remedy(refused, tmp_path, finished_run, name, content, remedy):
    path = shutil.copytree(finished_run, tmp_path / "run") / name
    if content == "newer":
        saved = json.loads(path.read_text())
        saved["fit"]["render"]["colour"] = True
        content = json.dumps(saved)
    whole = path.read_bytes()
    path.write_bytes(whole[:content] if isinstance(content, int) else content.encode())
    text = refused("eval", tmp_path / "run")
    assert name in text
    assert remedy in text


def test_a_file_that_cannot_grow_is_named(refused, tmp_path, monkeypatch):
    def run(options):
        raise OSError(errno.EFBIG, "File too large", "out.json")

    monkeypatch.setattr(Synth, "execute", run)
    assert "out.json: File too large" in refused("synth", tmp_path / "new")


@pytest.mark.parametrize("place", ["checkpoints/5", "blocks/0/checkpoints/5", None])
def test_an_interrupted_fit_names_resume_only_with_a_checkpoint(
    tmp_path, run_command, monkeypatch, place
):
    def fit(*paths, **options):
        if place is not None:
            (tmp_path / place).mkdir(parents=True)
        raise Interrupted(signal.SIGINT)

    monkeypatch.setattr("p2gs_jax.pipeline.fit.fit", fit)
    code, text = run_command("fit", "castle", "--out", tmp_path, "--resume")
    assert (code, "--resume continues" in text) == (130, place is not None)
    assert "holds no run to continue: a new one begins." in " ".join(text.split())


def test_durations_are_parsed_or_refused():
    right = {"90": 90, "90s": 90, "5m": 300, "1h30m": 5400, "1m30s": 90, "1.5h": 5400, "0.5": 0.5}
    right |= {"1h2m3s": 3723, "1h30s": 3630}
    assert {text: parse_duration(text) for text in right} == right
    wrong = ["", "m", "-5m", "5 minutes", "1h90", "1h30.5", "1.5h30", "30s5", "1:30", "1e3"]
    wrong += ["1h30", "2h15", "1h05", "5m30", "1h2m3"]
    for text in wrong:
        with pytest.raises(UserError):
            parse_duration(text)
