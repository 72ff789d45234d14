"""Each deliberate fault, planted in a copy of the package, fails the test that has to notice it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from faults import FAULTS

ROOT = Path(__file__).resolve().parents[2]
FAILED = 1  # pytest: tests were collected and run, and some failed


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_the_fault_fits_the_code(fault):
    assert (ROOT / "p2gs_jax" / fault.file).read_text(encoding="utf-8").count(fault.right) == 1
    path = ROOT / "tests" / fault.caught_by.split("::")[0]
    assert path.is_file()
    if "::" in fault.caught_by:
        assert f"def {fault.caught_by.split('::')[1]}(" in path.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_the_fault_is_noticed(fault, tmp_path):
    for name in ("p2gs_jax", "tests"):
        shutil.copytree(ROOT / name, tmp_path / name)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    path = tmp_path / "p2gs_jax" / fault.file
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(fault.right, fault.wrong), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", f"tests/{fault.caught_by}"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    # With any other status pytest itself could not run.
    assert done.returncode == FAILED, done.stdout + done.stderr
