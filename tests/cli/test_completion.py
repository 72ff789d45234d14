"""Completion: the scripts are what the shells can read, and know commands, options and paths."""

import shutil
import subprocess

import pytest

from p2gs_jax.cli.parser import completion_script

TRY = """
source {script}
try() {{
  COMP_WORDS=("$@"); COMP_CWORD=$(( $# - 1 )); COMPREPLY=()
  _p2gs_jax
  echo "${{#COMPREPLY[@]}} ${{COMPREPLY[*]}}"
}}
"""


@pytest.fixture(scope="module")
def bash(tmp_path_factory):
    """Return a function from the words before the cursor to what bash would offer."""
    if shutil.which("bash") is None:
        pytest.skip("there is no bash here")
    path = tmp_path_factory.mktemp("bash") / "completion"
    path.write_text(completion_script("bash"))
    elsewhere = tmp_path_factory.mktemp("without_files")

    def run(code):
        done = subprocess.run(
            ["bash", "--norc", "-c", TRY.format(script=path) + code],
            capture_output=True,
            text=True,
            check=True,
            cwd=elsewhere,  # a checkout has `runs/` once the README was followed
        )
        assert done.stderr == ""
        return done.stdout.split()

    return run


def test_commands_are_completed(bash):
    assert bash("try p2gs-jax re") == ["2", "render", "report"]
    assert bash("try p2gs-jax cal") == ["1", "calibrate"]


def test_options_and_their_values_are_completed(bash):
    assert bash("try p2gs-jax fit --pre") == ["1", "--preset"]
    assert bash("try p2gs-jax fit castle --photometry.cu") == ["1", "--photometry.curve"]
    assert "paper_appendix" in bash('try p2gs-jax fit castle --preset ""')
    assert bash("try p2gs-jax synth town --sensor.curve f") == ["1", "filmic"]


def test_a_path_of_cameras_is_a_word_or_a_file(bash):
    assert bash('try p2gs-jax render RUN --path ""') == ["3", "views", "drive", "orbit"]
    assert bash("try p2gs-jax render RUN --path dr") == ["1", "drive"]
    assert bash("try p2gs-jax render RUN --path cameras.j") == ["0"]
    for shell in ("zsh", "fish"):
        assert "'choices': ['views', 'drive', 'orbit']" in completion_script(shell)


def test_paths_are_left_to_bash(bash):
    assert bash("try p2gs-jax fit cast") == ["0"]
    assert bash("try p2gs-jax fit castle --out ru") == ["0"]
    assert "default" in bash("complete -p p2gs-jax")


@pytest.mark.parametrize(("shell", "check"), [("zsh", "-n"), ("fish", "--no-execute")])
def test_other_shells(tmp_path, shell, check):
    text = completion_script(shell)
    assert "--preset" in text
    assert "calibrate" in text
    path = tmp_path / "completion"
    path.write_text(text)
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} here")
    subprocess.run([shell, check, str(path)], check=True)
