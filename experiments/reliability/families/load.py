"""Sustained load: browsers on one viewer, many fits in one process, a sweep with failures."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

from reliability.families import _fits as fits
from reliability.families._checks import Check, failures, rows
from reliability.families._fits import Trial
from reliability.families._fits_load import try_many_fits
from reliability.families._scenes import Made, write_scene
from reliability.families._sweep_load import try_sweep
from reliability.families._viewer_load import try_viewer
from reliability.family import Failure, Family, Mended, Report

NAME = "load"
ABOUT = """
200 fits of two scenes run in one process, each with a seed of its own and the photometric model
given; eight browsers, one of them a real page where there is Chromium, move through one viewer for
ten minutes, then one of them reads nothing, then all leave, half of them without a word; a sweep of
100 runs has every tenth fail, and as many killed once. Survived: each number below is no more than
it may be. A browser's latency is from a move to its picture, and it moves again a fifth of a second
later; it is measured beside whatever else the machine does, on two cores the other browsers and the
real page itself.
"""
MENDED = (
    Mended(
        "a fit with another seed compiled its optimiser anew, and kept the program",
        "tests/train/test_step_programs.py"
        "::test_what_was_begun_before_exposures_were_known_is_used_where_it_fits",
    ),
)
SECONDS, SECONDS_QUICK = 600.0, 20.0
SLOW_S, SLOW_S_QUICK = 60.0, 10.0
FITS, FITS_QUICK = 200, 15
RUNS, RUNS_QUICK = 100, 10


def run(quick: bool, out: Path, report: Report) -> Family:
    """Load everything, one after the other."""
    scenes = [
        write_scene(out / "scene", Made()),
        write_scene(out / "other", Made(views=8, sizes=((48, 64),)), seed=1),
    ]
    # Programs as users have them, compiled once for all parts.
    env = fits.environment(out / "compiled")
    del env["XLA_FLAGS"]
    count = FITS_QUICK if quick else FITS
    viewed = out / "fits" / str(count - 1)
    seconds, slow_s = (SECONDS_QUICK, SLOW_S_QUICK) if quick else (SECONDS, SLOW_S)
    parts: dict[str, Callable[[Path], list[Check]]] = {
        "fits": lambda at: try_many_fits(scenes, at, env, count, report),
        "viewer": lambda at: try_viewer(viewed, at, env, seconds, slow_s, report),
        "sweep": lambda at: try_sweep(scenes[0], at, env, RUNS_QUICK if quick else RUNS, report),
    }
    found: list[Check] = []
    broken: list[Failure] = []
    for name, part in parts.items():
        at = out / name
        at.mkdir()
        try:
            checks = part(at)
        except (Trial, OSError, subprocess.TimeoutExpired) as error:
            broken.append(Failure(name, f"{type(error).__name__}: {error}"))
            continue
        found += checks
        for row in rows(checks):
            report("load: " + ", ".join(f"{k} {v}" for k, v in row.items()))
    tried = sum(check.most is not None for check in found) + len(broken)
    failed = (*broken, *failures(found))
    return Family(NAME, tried, tried - len(failed), failed, MENDED, figures=rows(found))
