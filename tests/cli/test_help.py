"""Help appears at once, fits into 80 columns, and its examples can be parsed."""

import os
import re
import shlex
from datetime import date
from pathlib import Path

import pytest

from p2gs_jax.cli.parser import COMMANDS, GROUPS, parse
from p2gs_jax.options import SHORT

HEAVY = ("jax", "numpy", "cv2", "equinox", "rich")


@pytest.fixture
def shown(run_command, monkeypatch):
    """Return a function from the words of a command line to its exit status and its help."""
    monkeypatch.setenv("COLUMNS", "80")
    return run_command


def wide(text):
    """Return lines beyond 80 columns, except the one-line summary of usage."""
    return [line for line in text.splitlines() if len(line) > 80 and not line.startswith("usage:")]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_fits_and_its_examples_can_be_parsed(shown, name):
    code, text = shown(name, "--help")
    assert code == 0
    options, _, examples = text.partition("Examples:")
    assert not wide(options)
    # A default of None is not shown.
    assert "{None}" not in text
    assert "default: None" not in text
    found = [line for line in examples.splitlines() if line.strip().startswith("p2gs-jax ")]
    assert found
    for line in found:
        words = shlex.split(line.partition(">")[0])
        assert parse(words[1:])[0] == name


def test_the_overview_names_every_command_once_and_in_order(shown):
    code, text = shown("--help")
    assert code == 0
    assert not wide(text)
    names = [line.split()[0] for line in text.splitlines() if line.startswith("  ")]
    wanted = [name for group in GROUPS.values() for name in group]
    assert [n for n in names if n in COMMANDS] == wanted
    assert shown() == (2, text)
    code, text = shown("--version")
    assert code == 0
    assert text.startswith("p2gs-jax ")
    assert text.split()[1][0].isdigit()


def test_help_has_common_options_and_help_all_the_rest(shown):
    _, brief = shown("fit", "--help")
    _, whole = shown("fit", "--help-all")
    for option in ("--out DIR", "--budget TIME", "--preset NAME", "--gaussians N"):
        assert option in brief
        assert option in whole
    assert "--help-all" in brief
    assert "--render.tile" not in brief
    for option in ("--render.tile N N", "--loss.dssim-weight", "--densify.method", "--train.batch"):
        assert option in whole
    assert not wide(whole.partition("Examples:")[0])
    assert brief.index("--budget") < brief.index("--seed")
    _, paper = shown("fit", "--preset", "paper", "--help-all")
    assert paper.count("(default: 30000)") == whole.count("(default: 30000)") + 1


def test_calibrate_has_the_options_that_it_reads(shown):
    _, text = shown("calibrate", "--help-all")
    found = set(re.findall(r"--([a-z]+)\.", text))
    assert found == {"data", "photometry", "loss", "train"}
    argv = "calibrate a --out b --preset paper --loss.black 0.1"
    _, options = parse(argv.split())
    assert (options.config.loss.black, options.config.loss.dssim_weight) == (0.1, 0.2)
    assert options.config.train.steps == 30_000


def test_a_preset_sets_defaults_and_options_are_read_as_their_types():
    argv = "fit a --out b --preset=paper --render.near 0.1 --render.stop-error None"
    _, options = parse([*argv.split(), *["--train.coarse-to-fine", ".1", ".2", "--resume"]])
    assert options.config.preset == "paper"
    assert options.config.train.steps == 30_000
    assert options.config.render.near == 0.1
    assert options.resume
    assert options.config.render.stop_error is None
    assert options.config.train.coarse_to_fine == (0.1, 0.2)


VALUES = {"budget": ("90s", 90.0), "cameras": ("front", ("front",)), "exposure_sigma": ("2", 2)}
VALUES |= {name: ("a", "a") for name in ("split", "background", "images", "drive", "frames")}
VALUES |= {name: ("a", "a") for name in ("known_exposures", "lpips_weights")}
VALUES |= {"allow_missing": ("", True), "camera_by": ("folder", "folder")}


@pytest.mark.parametrize("which", ["short", "long"])
def test_short_and_long_names_set_the_same_field(which):
    words = "fit a --out b"
    for name, (path, _) in SHORT.items():
        option = (name if which == "short" else path).replace("_", "-")
        words += f" --{option} {VALUES.get(name, ('64', 64))[0]}"
    cfg = parse(words.split())[1].config
    for name, (path, _) in SHORT.items():
        group, field = path.split(".")
        assert getattr(getattr(cfg, group), field) == VALUES.get(name, ("64", 64))[1], name


def test_the_last_spelling_of_an_option_counts():
    _, options = parse(["fit", "a", "--max-width", "64", "--data.max-width", "32"])
    assert options.config.data.max_width == 32


def test_a_run_folder_has_the_name_of_the_scene_and_the_date(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("", "-2", "-3"):
        run = parse(["fit", "data/castle"])[1].run_folder()
        assert run == Path(f"runs/castle-{date.today()}{name}")
        run.mkdir(parents=True)
    (tmp_path / f"runs/castle-{date.today()}-2/config.json").touch()
    assert parse(["fit", "castle", "--resume"])[1].run_folder().name.endswith("-2")


def test_help_imports_nothing_heavy(python):
    child = (
        "import sys\nfrom p2gs_jax.cli import main\n"
        "for argv in (['--help'], ['fit', '--help-all'], ['synth', '--help']):\n"
        "    try:\n        main(argv)\n    except SystemExit:\n        pass\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules], file=sys.stderr)"
    )
    done = python("-c", child)
    assert done.stderr.strip() == "[]"
    assert done.stdout.count("usage: p2gs-jax") >= 3


@pytest.fixture
def broken(tmp_path, python):
    """Return a function that runs p2gs-jax with a library that raises when imported."""

    def run(module, *argv, status):
        (tmp_path / f"{module}.py").write_text("raise ImportError('libfoo.so.1 is missing')")
        path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
        return python("-m", "p2gs_jax.cli", *argv, status=status, PYTHONPATH=path)

    return run


def test_nothing_is_imported_from_the_working_folder(python, hostile):
    """`python -m` alone searches the working folder, which often is the scene."""
    argv, root = ("calibrate", ".", "--out", "new"), str(Path(__file__).parents[2])
    done = python("-m", "p2gs_jax.cli", *argv, status=2, PYTHONPATH=root)
    assert "no scene in ." in done.stderr
    assert not hostile.exists()


@pytest.mark.parametrize("module", ["jax", "tyro", "cv2"])
def test_a_broken_library_is_named_with_a_remedy(broken, tmp_path, module):
    done = broken(module, "calibrate", tmp_path, "--out", tmp_path / "out", status=2)
    assert "libfoo.so.1 is missing" in done.stderr
    assert "p2gs-jax doctor" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("module", ["jax", pytest.param("tyro", marks=pytest.mark.slow)])
def test_doctor_survives_a_broken_library(broken, module):
    done = broken(module, "doctor", "--skip-self-test", status=1)
    assert "libfoo.so.1 is missing" in done.stdout
    assert "Traceback" not in done.stderr + done.stdout
    assert "force-reinstall" in done.stdout
