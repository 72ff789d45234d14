"""Plant each deliberate fault in a copy of the package and run the test that has to notice it.

python tests/faults/apply.py [PART OF A NAME ...]

Prints one line a fault; the exit code is the number of those that nothing noticed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from faults import FAULTS, Fault

ROOT = Path(__file__).resolve().parents[2]
FAILED = 1  # pytest: tests were collected and run, and some failed


def planted(fault: Fault, folder: Path) -> None:
    """Copy package and tests into a folder, with the fault.

    Raises:
        ValueError: the text that the fault replaces does not occur exactly once.
    """
    ignored = shutil.ignore_patterns("__pycache__")
    for name in ("p2gs_jax", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)
    path = folder / "p2gs_jax" / fault.file
    text = path.read_text(encoding="utf-8")
    if text.count(fault.right) != 1:
        raise ValueError(
            f"{fault.name}: {fault.file} holds its text {text.count(fault.right)} times"
        )
    path.write_text(text.replace(fault.right, fault.wrong), encoding="utf-8")


def noticed(fault: Fault) -> bool:
    """Return whether the fault's test fails, for a reason that is not the fault's own making."""
    with tempfile.TemporaryDirectory() as folder:
        planted(fault, Path(folder))
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", f"tests/{fault.caught_by}"],
            cwd=folder,
            env=dict(os.environ, PYTHONPATH=folder),
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode not in (0, FAILED):
        raise RuntimeError(f"{fault.name}: pytest did not run\n{done.stdout}{done.stderr}")
    return done.returncode == FAILED


def main(wanted: list[str]) -> int:
    missed = 0
    for fault in FAULTS:
        if wanted and not any(part in fault.name for part in wanted):
            continue
        begin = time.perf_counter()
        found = noticed(fault)
        missed += not found
        word = "noticed" if found else "MISSED "
        print(f"{word} {time.perf_counter() - begin:5.1f} s  {fault.name}", flush=True)
    return missed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
