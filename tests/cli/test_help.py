"""Help that a person can work from: at once, at 80 columns, with examples that are right."""

import os
import shlex
import subprocess
import sys

import pytest

from p2gs_jax.cli import main
from p2gs_jax.cli.parser import COMMANDS, GROUPS, parse

HEAVY = ("jax", "numpy", "cv2", "equinox", "rich")


def shown(capsys, monkeypatch, *argv, columns=80):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit) as stop:
        main(list(argv))
    out = capsys.readouterr()
    return stop.value.code, out.out + out.err


def wide(text):
    """Return lines beyond 80 columns, but for the one-line summary of usage."""
    return [line for line in text.splitlines() if len(line) > 80 and not line.startswith("usage:")]


def examples(text):
    return [line.strip() for line in text.splitlines() if line.strip().startswith("p2gs-jax ")]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command(capsys, monkeypatch, name):
    code, text = shown(capsys, monkeypatch, name, "--help")
    assert code == 0
    assert not wide(text.partition("Examples:")[0])
    assert "@" not in text
    assert "{None}" not in text
    # In a command's own options None says nothing; in the configuration it is a value like others.
    assert "default: None" not in text.partition("--render.")[0]
    found = examples(text.partition("Examples:")[2])
    assert found
    for line in found:
        words = shlex.split(line.partition(">")[0])
        assert parse(words[1:])[0] == name


def test_overview_names_every_command_once_and_in_order(capsys, monkeypatch):
    code, text = shown(capsys, monkeypatch, "--help")
    assert code == 0
    assert not wide(text)
    assert "Other" not in text
    names = [line.split()[0] for line in text.splitlines() if line.startswith("  ")]
    wanted = [name for group in GROUPS.values() for name in group if name in COMMANDS]
    assert [n for n in names if n in COMMANDS] == wanted
    assert set(wanted) == set(COMMANDS)


def test_nothing_asked_is_answered_by_the_overview_and_2(capsys, monkeypatch):
    code, text = shown(capsys, monkeypatch)
    assert code == 2
    assert "From photographs" in text


def test_version(capsys, monkeypatch):
    code, text = shown(capsys, monkeypatch, "--version")
    assert code == 0
    assert text.startswith("p2gs-jax ")
    assert text.split()[1][0].isdigit()


def test_common_options_come_first_and_the_rest_on_request(capsys, monkeypatch):
    _, brief = shown(capsys, monkeypatch, "fit", "--help")
    _, whole = shown(capsys, monkeypatch, "fit", "--help-all")
    for option in ("--out DIR", "--budget TIME", "--preset NAME", "--gaussians N"):
        assert option in brief
        assert option in whole
    assert "--help-all" in brief
    assert "--render.tile" not in brief
    assert "--render.tile N N" in whole
    assert not wide(whole.partition("Examples:")[0])
    assert brief.index("--budget") < brief.index("--seed")


def test_a_preset_decides_the_defaults_that_help_names(capsys, monkeypatch):
    _, text = shown(capsys, monkeypatch, "fit", "--preset", "paper", "--help-all")
    of_robust = shown(capsys, monkeypatch, "fit", "--help-all")[1]
    assert text.count("(default: 30000)") == of_robust.count("(default: 30000)") + 1


def test_a_preset_decides_the_values():
    _, options = parse(["fit", "a", "--out", "b", "--preset=paper", "--render.near", "0.1"])
    assert options.config.preset == "paper"
    assert options.config.train.steps == 30_000
    assert options.config.render.near == 0.1


def test_options_are_read_as_what_they_are():
    argv = "fit a --out b --steps 7 --render.stop-error None"
    _, options = parse([*argv.split(), "--train.coarse-to-fine", ".1", ".2", "--resume"])
    assert options.config.train.steps == 7
    assert options.resume
    assert options.config.render.stop_error is None
    assert options.config.train.coarse_to_fine == (0.1, 0.2)


@pytest.mark.parametrize("argv", [["--help"], ["fit", "--help-all"], ["synth", "--help"]])
def test_help_imports_nothing_heavy(argv):
    child = (
        "import sys\nfrom p2gs_jax.cli import main\n"
        f"try:\n    main({argv!r})\nexcept SystemExit:\n    pass\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    assert "usage: p2gs-jax" in done.stdout


@pytest.fixture
def broken(tmp_path):
    """Return a function that runs the command line where a library raises when imported."""

    def run(module, *argv):
        (tmp_path / f"{module}.py").write_text("raise ImportError('libfoo.so.1 is missing')")
        path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
        return subprocess.run(
            [sys.executable, "-m", "p2gs_jax.cli", *argv],
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
        )

    return run


@pytest.mark.parametrize("module", ["jax", "tyro", "cv2"])
def test_a_broken_library_is_named_with_what_to_do(broken, tmp_path, module):
    done = broken(module, "calibrate", str(tmp_path), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "libfoo.so.1 is missing" in done.stderr
    assert "p2gs-jax doctor" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("module", ["jax", pytest.param("tyro", marks=pytest.mark.slow)])
def test_doctor_survives_what_it_looks_for(broken, module):
    done = broken(module, "doctor", "--skip-self-test")
    assert done.returncode == 1, done.stderr
    assert "libfoo.so.1 is missing" in done.stdout
    assert "Traceback" not in done.stderr + done.stdout
    assert "force-reinstall" in done.stdout
