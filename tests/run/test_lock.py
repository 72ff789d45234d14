"""One process writes to a run folder; a crash leaves no lock."""

import os
import shutil
import subprocess
import sys

import pytest

import p2gs_jax
from p2gs_jax.errors import UserError
from p2gs_jax.run.folder import NAME, locked, require_free

HOLD = """
import os, sys
from pathlib import Path
from p2gs_jax.run.folder import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_holder_is_refused_with_the_process_of_the_first(tmp_path):
    require_free(tmp_path)
    with locked(tmp_path):
        for attempt in (require_free, lambda folder: locked(folder).__enter__()):
            with pytest.raises(UserError, match=rf"process {os.getpid()}\.") as error:
                attempt(tmp_path)
            assert "--out" in str(error.value)
        assert (tmp_path / NAME).read_text().strip() == str(os.getpid())
    assert list(tmp_path.iterdir()) == []
    with locked(tmp_path):
        pass


def test_unfinished_files_of_killed_processes_are_removed(tmp_path):
    for name in (".writing-a.npz", "renders/.writing-b.png", ".writing-c/d", "blocks/.writing-e"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "kept.npz").touch()
    with locked(tmp_path / "blocks"):
        (tmp_path / "blocks" / ".writing-theirs").touch()
        with locked(tmp_path):
            pass
    left = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {"kept.npz", "blocks/.writing-theirs"}


def test_a_killed_process_leaves_no_lock(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=rf"process {process.pid}\."):
            require_free(tmp_path)
        process.kill()
    assert (tmp_path / NAME).exists()
    require_free(tmp_path)
    with locked(tmp_path) as lock:
        lock.require()
    assert not (tmp_path / NAME).exists()


@pytest.mark.parametrize("anew", [False, True])
def test_a_folder_that_was_removed_during_a_run_is_named(tmp_path, anew):
    run = tmp_path / "run"
    run.mkdir()

    def write():
        with locked(run):
            shutil.rmtree(run)
            if anew:
                run.mkdir()
                (run / NAME).write_text("1")
            (run / "checkpoints" / "3").stat()  # the first access of the run

    with pytest.raises(FileNotFoundError), locked(tmp_path):
        (tmp_path / "nowhere").stat()  # other errors stay as they are
    with pytest.raises(UserError, match="was removed or replaced") as error:
        write()
    assert isinstance(error.value.__context__, FileNotFoundError)
    assert run.exists() == anew


def test_a_fit_or_calibration_into_a_folder_in_use_is_refused(tmp_path, refused):
    (tmp_path / "scene").mkdir()
    run = tmp_path / "run"
    run.mkdir()
    with locked(run):
        for command in ("fit", "fit --resume", "calibrate", "calibrate --static"):
            text = refused(*command.split(), tmp_path / "scene", "--out", run)
            assert f"process {os.getpid()}" in text
        with pytest.raises(UserError, match=f"process {os.getpid()}"):
            p2gs_jax.calibrate_run("nowhere", run)
        assert [p.name for p in run.iterdir()] == [NAME]
