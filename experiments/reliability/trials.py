"""Trials in children of one warm process: their output, exit codes, times and memory.

A trial ends well if it is done, or refuses with code 2, the file, the fault and a remedy. It may
neither take long nor much memory, nor touch anything but its own folder.
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from reliability.family import Failure, Family, Report

SECONDS = 30.0
BYTES = 2 * 2**30
REFUSED = 2
ENDS: dict[int | None, str] = {0: "done", REFUSED: "refused"}
# Exit code of a child whose input was read but makes no sense.
NONSENSE = 70
_GRANULE = 0.01


@dataclass(frozen=True)
class Trial:
    """Something to be survived."""

    name: str  # unique in its family
    # writes the input into an empty folder; returns the folder or file to name, if another one
    make: Callable[[Path], Path | None]
    # runs on the named input in a child; its exit code is that of the command line
    act: Callable[[Path], int]
    # one of these words has to be in a refusal; empty: a path below the folder
    named: tuple[str, ...] = ()
    refused: bool | None = None  # it has to be refused; None: may be read or refused
    seconds: float = SECONDS  # that it may take
    data: int = BYTES  # bytes of memory that it may ask for; resident it may have `BYTES`


@dataclass(frozen=True)
class Outcome:
    """How a child ended."""

    code: int | None  # exit status; negative: by this signal; None: it took too long
    text: str  # all that it printed
    seconds: float  # that it took
    peak: int  # resident memory, bytes


def run_trials(name: str, trials: Sequence[Trial], out: Path, report: Report) -> Family:
    """Try all, one child each.

    Args:
        name: of the family.
        trials: all of them.
        out: an empty folder; every trial has a folder of its own there while it runs.
        report: receives progress.
    """
    failures, outcomes = [], []
    kinds: Counter[str] = Counter()
    for number, trial in enumerate(trials, 1):
        outcome, reason = attempt(trial, out / "trial")
        outcomes.append(outcome)
        kinds[ENDS.get(outcome.code, "neither")] += 1
        if reason is not None:
            failures.append(Failure(trial.name, reason))
            report(f"{trial.name}: {reason}")
        if number % 50 == 0:
            report(f"{name}: {number} of {len(trials)}, {len(failures)} failed")
    figures = {
        "done": kinds["done"],
        "refused": kinds["refused"],
        "neither": kinds["neither"],
        "longest, s": max((o.seconds for o in outcomes), default=0.0),
        "largest peak, MiB": round(max((o.peak for o in outcomes), default=0) / 2**20),
    }
    survived = len(trials) - len(failures)
    return Family(name, len(trials), survived, tuple(failures), figures=(figures,))


def attempt(trial: Trial, folder: Path) -> tuple[Outcome, str | None]:
    """Make and try one; return its end, and the fault of that end or None."""
    shutil.rmtree(folder, ignore_errors=True)
    scene, elsewhere = folder / "scene", folder / "elsewhere"
    scene.mkdir(parents=True)
    elsewhere.mkdir()
    named = trial.make(scene) or scene
    before = _listing(folder)
    outcome = in_child(lambda: trial.act(named), elsewhere, trial.seconds, trial.data)
    reason = _wrong(trial, outcome, folder)
    if reason is None:
        new = sorted(set(_listing(folder)) - set(before))
        if new:
            reason = f"wrote {new[0]}"
    shutil.rmtree(folder, ignore_errors=True)
    return outcome, reason


def in_child(act: Callable[[], int], cwd: Path, seconds: float, data: int) -> Outcome:
    """Run a function in a forked child, limited in time and memory."""
    log = cwd.parent / "printed"
    sys.stdout.flush()
    sys.stderr.flush()
    start = time.perf_counter()
    child = os.fork()
    if child == 0:
        _behave(act, cwd, log, data)
    code, peak = _reap(child, start + seconds)
    text = log.read_bytes().decode("utf-8", "replace") if log.exists() else ""
    log.unlink(missing_ok=True)
    return Outcome(code, text, time.perf_counter() - start, peak)


def _behave(act: Callable[[], int], cwd: Path, log: Path, data: int) -> None:
    """Be the child: print into a file, and leave without any of the parent's clean-up."""
    code = 1
    try:
        os.setsid()
        os.chdir(cwd)
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        resource.setrlimit(resource.RLIMIT_DATA, (data, data))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = act()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _reap(child: int, deadline: float) -> tuple[int | None, int]:
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), usage.ru_maxrss * 1024
        if time.perf_counter() > deadline:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            _, _, usage = os.wait4(child, 0)
            return None, usage.ru_maxrss * 1024
        time.sleep(_GRANULE)


def _wrong(trial: Trial, outcome: Outcome, folder: Path) -> str | None:
    """Return the fault in the end of a trial, or None."""
    last = next((line for line in reversed(outcome.text.splitlines()) if line.strip()), "")
    if outcome.code is None:
        return f"took more than {trial.seconds:.0f} s"
    if outcome.code < 0:
        return f"ended by signal {signal.Signals(-outcome.code).name}"
    if "Traceback (most recent call last)" in outcome.text:
        return f"traceback: {last}"
    if outcome.code not in (0, REFUSED):
        return f"code {outcome.code}: {last}"
    if outcome.peak > BYTES:
        return f"took {outcome.peak / 2**20:.0f} MiB"
    if trial.refused is not None and trial.refused != (outcome.code == REFUSED):
        return "was refused: " + last if trial.refused is False else "was not refused"
    if outcome.code == REFUSED:
        if "To fix it:" not in outcome.text:
            return f"no remedy: {last}"
        if not any(word in outcome.text for word in trial.named or (str(folder),)):
            return f"no file is named: {last}"
    control = {c for c in outcome.text if (ord(c) < 32 and c not in "\n\t\r") or c == "\x7f"}
    if control:
        return f"control characters on the terminal: {control}"
    return None


def _listing(folder: Path) -> Iterable[str]:
    return [
        os.path.relpath(os.path.join(at, name), folder)
        for at, folders, files in os.walk(folder)
        for name in (*folders, *files)
    ]
