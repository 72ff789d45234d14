"""Everyday commands: `nox -s lint`, `nox -s tests`, ... `nox -l` lists them.

They run in the environment that nox was started from (`pip install -e '.[dev,docs]'`): its
libraries are large, and `.ci/run` checks a fresh one. Only `audit` and `wheel` make one.
"""

from __future__ import annotations

import shutil
import sys
import sysconfig
from pathlib import Path

import nox

nox.options.default_venv_backend = "none"
nox.options.sessions = ["lint", "tests", "docs"]
BASELINE = "experiments/bench/baseline.json"
# Tests that reach most annotations in little time.
SHAPES = ("render/test_project.py", "render/test_warp.py", "render/test_objects.py")
SHAPES += ("gaussians/test_densify.py", "gaussians/test_init.py", "gaussians/test_sampling.py")
SHAPES += ("core/test_programs_of_a_fit.py", "photometry/test_formation.py", "properties")


@nox.session
def lint(session: nox.Session) -> None:
    """Check format, rules, imports and types."""
    session.run("ruff", "format", "--check", ".")
    session.run("ruff", "check", ".")
    session.run("lint-imports")
    session.run("pyright", "--pythonpath", sys.executable)


@nox.session
def tests(session: nox.Session) -> None:
    """Run the tests, or those named: nox -s tests -- tests/render -k needle."""
    session.run("pytest", *session.posargs)


@nox.session
def slow(session: nox.Session) -> None:
    """Run the longer checks."""
    session.run("pytest", "-m", "slow", *session.posargs)


@nox.session
def shapes(session: nox.Session) -> None:
    """Run some of the tests with every shape and type in annotations checked."""
    checked = "--jaxtyping-packages=p2gs_jax,beartype.beartype"
    session.run("pytest", "-n", "0", checked, *(session.posargs or (f"tests/{t}" for t in SHAPES)))


@nox.session
def docs(session: nox.Session) -> None:
    """Build the site; every warning is an error. `nox -s docs -- serve` shows it live."""
    session.run("mkdocs", *(session.posargs or ("build", "--strict")))


@nox.session(venv_backend="venv")
def audit(session: nox.Session) -> None:
    """Look for known vulnerabilities of installed packages; needs the JSON interface of PyPI."""
    session.install("pip-audit")
    session.run("pip-audit", "--path", sysconfig.get_paths()["purelib"])


@nox.session(venv_backend="venv")
def wheel(session: nox.Session) -> None:
    """Build sdist and wheel, check them, and try the wheel away from the sources."""
    place = Path(session.create_tmp()).resolve()
    dist = place / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    session.install("build", "twine")
    session.run("python", "-m", "build", "--outdir", str(dist))
    session.run("twine", "check", "--strict", *map(str, sorted(dist.iterdir())))
    session.install(str(next(dist.glob("*.whl"))))
    session.chdir(place)
    session.run("p2gs-jax", "--help", silent=True)
    session.run("p2gs-jax", "doctor")
    session.run("python", "-c", "import p2gs_jax; [getattr(p2gs_jax, n) for n in p2gs_jax.__all__]")


@nox.session
def bench(session: nox.Session) -> None:
    """Compare the renderer with the baseline, as CI does."""
    parts = session.posargs or ("speed_error", "levels", "--quick")
    out = Path(session.create_tmp()).resolve()
    session.run("python", "benchmarks/run.py", *parts, "--out", str(out), "--baseline", BASELINE)
