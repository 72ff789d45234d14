"""Faults while a fit runs: it is killed, stopped, robbed of disk, folder, memory and clock."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from reliability.families import _fits as fits
from reliability.families._fits import Trial
from reliability.families._scenes import Made, write_scene
from reliability.family import Failure, Family, Report

NAME = "faults"
ABOUT = """
A fit is killed at random moments (also while it writes checkpoints and results), asked to end, and
loses disk, folder, memory or clock. A trial is survived if the fit ends with the exit code and the
words that belong to the fault, without a traceback. The resumed run then equals the uninterrupted
one byte for byte, times aside (log, Gaussians, photometry, scores).
"""
KILLS, KILLS_QUICK = 50, 4
# Bytes that a file may have: from no room for the first file to none for the checkpoint.
ROOMS = (0, 300, 1_000, 4_000, 20_000, 60_000)
_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH, _PR_CAPBSET_DROP = 1, 2, 24

_CLOCK = """
import sys, threading, time
real, steps = time.time, iter(range(10**9))
time.time = lambda: real() - 86400 * (next(steps) % 3)
from p2gs_jax.cli import main
main(sys.argv[1:])
"""
_MEMORY = """
import pathlib, resource, sys, threading, time
from p2gs_jax.cli import main
log, wanted = pathlib.Path(sys.argv.pop(1)), int(sys.argv.pop(1))
def shrink():
    while not log.exists() or log.read_bytes().count(b"\\n") < wanted:
        time.sleep(.002)
    pages = int(open("/proc/self/statm").read().split()[0])
    limit = pages * resource.getpagesize() + (1 << 20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
threading.Thread(target=shrink, daemon=True).start()
main(sys.argv[1:])
"""


def _as_in_a_terminal() -> None:
    """Let signals arrive that children of nohup, or of a background shell, would ignore."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


class Faults:
    """The trials, on one scene and against one uninterrupted run."""

    def __init__(self, out: Path):
        self.out, self.env = out, fits.environment(out / "compiled")
        self.scene = write_scene(out / "scene", Made())
        self.whole = out / "whole"
        fits.run(fits.command(self.scene, self.whole), self.env).require(0)
        self.rng = random.Random(0)

    def start(self, run: Path, *extra: str, **options):
        """Start a fit into a folder, or continue the one that is there."""
        if (run / "config.json").exists():
            extra = ("--resume", *extra)
        return fits.started(fits.command(self.scene, run, *extra), self.env, **options)

    def finish(self, run: Path) -> None:
        """Continue a run undisturbed and compare it with the uninterrupted one."""
        extra = ("--resume",) if (run / "config.json").exists() else ()
        fits.run(fits.command(self.scene, run, *extra), self.env).require(0)
        fits.require_same(self.whole, run)

    def killed(self, run: Path, kills: int, report: Report) -> list[tuple[str, str | None]]:
        """Kill fits until there were enough kills; every run ends as the uninterrupted one."""
        found: list[tuple[str, str | None]] = []
        while len(found) < kills:
            chain: list[str] = []
            shutil.rmtree(run, ignore_errors=True)
            reason = None
            try:
                while len(found) + len(chain) < kills and len(chain) < 6:
                    moment = self._kill(run)
                    if moment is None:
                        break
                    chain.append(moment)
                self.finish(run)
            except Trial as trial:
                reason = str(trial)
            found += [(f"killed {moment}", reason) for moment in chain]
            report(f"faults: {len(found)} of {kills} kills, {chain[-1:]}: {reason or 'survived'}")
        return found

    def _kill(self, run: Path) -> str | None:
        """Kill a fit and return when; None where it ended first."""
        before = fits.lines(run)
        with self.start(run) as process:
            kind = self.rng.choice(("any", "step", "checkpoint", "writing", "step"))
            if kind == "any":
                delay = self.rng.uniform(0, 8)
                fits.wait_for(process, _after(delay))
                moment = f"{delay:.2f} s after its start"
            elif kind == "step":
                wanted = before + self.rng.randint(1, 4)
                delay = self.rng.uniform(0, 0.1)
                fits.wait_for(process, lambda: fits.lines(run) >= wanted)
                fits.wait_for(process, _after(delay))
                moment = "after a line of its log"
            elif kind == "checkpoint":
                folder = run / "checkpoints"
                fits.wait_for(process, lambda: any(folder.glob(".writing-*")))
                moment = "while it wrote a checkpoint"
            else:
                fits.wait_for(process, lambda: (run / "renders").exists())
                fits.wait_for(process, _after(self.rng.uniform(0, 0.5)))
                moment = "while it wrote its results"
            if process.poll() is not None:
                return None
            process.send_signal(signal.SIGKILL)
            fits.end(process)
        return moment

    def asked(self, run: Path, number: int, word: str) -> None:
        """Ask a fit to end between steps."""
        rare = ("--train.checkpoint-every-s", "1000")
        with self.start(run, *rare, preexec_fn=_as_in_a_terminal) as process:
            fits.wait_for(process, lambda: fits.lines(run) >= 3)
            process.send_signal(number)
            fits.end(process).require(128 + number, word, "--resume continues")
        # The interval of checkpoints must be that of the start of the run.
        again = fits.run(fits.command(self.scene, run, "--resume", *rare), self.env)
        again.require(0, "Resuming after step")
        fits.require_same(self.whole, run)

    def full(self, run: Path, room: int) -> None:
        """Let no file grow beyond so many bytes."""

        def limit() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))

        with self.start(run, preexec_fn=limit) as process:
            fits.end(process).require(2, str(run), "disk has room")
        self.finish(run)

    def read_only(self, run: Path) -> None:
        """Make the folder read-only, before the fit and in the middle of it."""
        run.mkdir()
        run.chmod(0o555)
        with self.start(run, preexec_fn=_without_rights) as process:
            fits.end(process).require(2, str(run), "Permission denied")
        run.chmod(0o755)
        with self.start(run, preexec_fn=_without_rights) as process:
            fits.wait_for(process, lambda: fits.lines(run) >= 2)
            (run / "checkpoints").chmod(0o555)
            fits.end(process).require(2, str(run), "Permission denied")
        (run / "checkpoints").chmod(0o755)
        self.finish(run)

    def removed(self, run: Path) -> None:
        """Remove the folder underneath."""
        with self.start(run) as process:
            fits.wait_for(process, lambda: fits.lines(run) >= 2)
            while run.exists():
                shutil.rmtree(run, ignore_errors=True)
            fits.end(process).require(2, str(run), "was removed")
        if (run / "config.json").exists():
            raise Trial("it made the folder anew")
        shutil.rmtree(run, ignore_errors=True)
        self.finish(run)

    def clock(self, run: Path) -> None:
        """Set the clock back by days, again and again."""
        argv = [sys.executable, "-c", _CLOCK, *fits.command(self.scene, run)[3:]]
        fits.run(argv, self.env).require(0)
        fits.require_same(self.whole, run)

    def second(self, run: Path) -> None:
        """Start another process in the same folder."""
        with self.start(run) as process:
            fits.wait_for(process, lambda: fits.lines(run) >= 1)
            process.send_signal(signal.SIGSTOP)  # or it might end before the second one begins
            for extra in ((), ("--resume",)):
                second = fits.run(fits.command(self.scene, run, *extra), self.env)
                second.require(2, f"process {process.pid}")
            process.send_signal(signal.SIGCONT)
            fits.end(process).require(0)
        fits.require_same(self.whole, run)

    def foretold(self, run: Path) -> None:
        """Leave less memory than the fit will take."""

        def limit() -> None:
            resource.setrlimit(resource.RLIMIT_AS, (12 << 30, resource.RLIM_INFINITY))

        argv = fits.command(self.scene, run, "--densify.max-gaussians", "90000000")
        ended = fits.run(argv, self.env, preexec_fn=limit)
        ended.require(2, "would take about", "--gaussians")
        if (run / "config.json").exists():
            raise Trial("it left a config.json")

    def out_of_memory(self, run: Path) -> None:
        """Take all memory away between steps: the fit reports it or dies, and can be resumed."""
        given = fits.command(self.scene, run)[3:]
        argv = [sys.executable, "-c", _MEMORY, str(run / "log.jsonl"), "3", *given]
        ended = fits.run(argv, self.env)
        if ended.code not in (0, 2) and ended.code >= 0:
            raise Trial(f"exit code {ended.code}: {ended.said[-300:]}")
        if ended.code == 2:
            ended.require(2, "memory ran out")
        self.finish(run)


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all faults."""
    faults = Faults(out)
    report("faults: the uninterrupted run is there")
    trials: dict[str, Callable[[Path], None]] = {
        "SIGTERM": lambda run: faults.asked(run, signal.SIGTERM, "SIGTERM"),
        "Ctrl-C": lambda run: faults.asked(run, signal.SIGINT, "Ctrl-C"),
        "SIGHUP": lambda run: faults.asked(run, signal.SIGHUP, "SIGHUP"),
        **{
            f"files of {room} bytes at most": lambda run, room=room: faults.full(run, room)
            for room in ROOMS
        },
        "read-only folder": faults.read_only,
        "folder removed": faults.removed,
        "clock set back": faults.clock,
        "a second process": faults.second,
        "too little memory, foretold": faults.foretold,
        "memory taken away": faults.out_of_memory,
    }
    if quick:
        quickly = ("SIGTERM", f"files of {ROOMS[-2]} bytes at most", "folder removed")
        quickly += ("a second process", "too little memory, foretold", "memory taken away")
        trials = {name: trials[name] for name in quickly}
    found = faults.killed(out / "killed", KILLS_QUICK if quick else KILLS, report)
    for number, (name, trial) in enumerate(trials.items()):
        reason = None
        try:
            trial(out / f"run_{number}")
        except Trial as error:
            reason = str(error)
        report(f"faults: {name}: {reason or 'survived'}")
        found.append((name, reason))
    failures = tuple(Failure(name, reason) for name, reason in found if reason is not None)
    return Family(NAME, len(found), len(found) - len(failures), failures)


def _after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() >= end


def _without_rights() -> None:
    """Drop what lets root write everywhere (Linux)."""
    if os.geteuid() == 0:
        import ctypes

        for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
            ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
