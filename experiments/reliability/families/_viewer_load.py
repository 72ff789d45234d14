"""Browsers on one `p2gs-jax view`, which says on a signal what it holds."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from reliability.families import _page
from reliability.families._browsers import Browser
from reliability.families._checks import Check
from reliability.families._fits import MOST_S, Trial
from reliability.families._processes import Held, held
from reliability.family import Report

BROWSERS = 8
# What must be true of the viewer.
GROWN_MB, LEFT_MB = 50.0, 50.0
SLOWER = 1.5
# Each visit of eight adds half of what the one before it added (arenas of the threads): 42, 19, 12,
# 6 MB.
WARM_UP_S, VISITS = 40.0, 3
# Once pages are closed, everything is gone after so many seconds.
GONE_S = 30.0

# On SIGUSR1 it writes what lives in it. It keeps weak references and asks the collector for no list
# of objects: that would hold tuples that JAX is just making in another thread, which then fails.
_TELLING = """
import gc, json, os, signal, sys, threading, weakref
from p2gs_jax.viewer.programs import Programs
from p2gs_jax.viewer.session import BrowserSession
path = sys.argv.pop(1)
made = {kind: weakref.WeakSet() for kind in (Programs, BrowserSession)}
def followed(kind):
    start = kind.__init__
    def init(self, *args, **named):
        made[kind].add(self)
        start(self, *args, **named)
    kind.__init__ = init
def tell(*_):
    gc.collect()
    said = {
        "sessions": len(made[BrowserSession]),
        "drawing threads": sum(t.name == "draw" for t in threading.enumerate()),
        "compiling": sum(len(p._wanted) + (p._now is not None) for p in made[Programs]),
    }
    with open(path + ".new", "w") as file:
        json.dump(said, file)
    os.replace(path + ".new", path)
for kind in made:
    followed(kind)
signal.signal(signal.SIGUSR1, tell)
from p2gs_jax.cli import main
main(sys.argv[1:])
"""


class Viewer:
    """A viewer that was started.

    Attributes:
        address: of its page.
        pid: its process.
        kept: its memory once a second while `sampled`, with the time (monotonic).
    """

    def __init__(self, process: subprocess.Popen, address: str, told: Path):
        self.address, self.pid = address, process.pid
        self.process, self.told = process, told
        self.kept: list[tuple[float, float]] = []

    def held(self) -> Held:
        """Return what the process holds."""
        return held(self.pid)

    def alive(self) -> dict[str, int]:
        """Return how many sessions and threads of browsers live in it, and programs to compile.

        Raises:
            Trial: it does not answer.
        """
        self.told.unlink(missing_ok=True)
        self.process.send_signal(signal.SIGUSR1)
        end = time.monotonic() + MOST_S
        while not self.told.exists():
            if self.process.poll() is not None or time.monotonic() > end:
                raise Trial("the viewer ended or hangs")
            time.sleep(0.05)
        return json.loads(self.told.read_text())

    async def sampled(self) -> None:
        """Note its memory once a second until cancelled."""
        while True:
            self.kept.append((time.monotonic(), self.held().mb))
            await asyncio.sleep(1)


@contextlib.contextmanager
def opened(run: Path, out: Path, env: dict[str, str]) -> Iterator[Viewer]:
    """Start a viewer.

    Raises:
        Trial: it does not start.
    """
    told, printed = out / "told.json", out / "printed"
    argv = [sys.executable, "-c", _TELLING, str(told), "view", str(run), "--port", "0"]
    with printed.open("wb") as file:
        process = subprocess.Popen(
            [*argv, "--max-width", "320"], env=env, stdout=file, stderr=subprocess.STDOUT
        )
    try:
        end, found = time.monotonic() + MOST_S, None
        while found is None:
            if process.poll() is not None or time.monotonic() > end:
                raise Trial(f"the viewer does not start: {printed.read_text()[-300:]}")
            time.sleep(0.1)
            found = re.search(r"at (http://\S+)", printed.read_text())
        yield Viewer(process, found[1], told)
        if "Traceback" in printed.read_text():
            raise Trial(f"the viewer printed a traceback: {printed.read_text()[-300:]}")
    finally:
        process.terminate()
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def look_together(viewer: Viewer, browsers: list[Browser], seconds: float, page: str | None) -> int:
    """Let browsers look at the same time; return how many messages the real page received.

    Args:
        viewer: where.
        browsers: who.
        seconds: to look for.
        page: where Chromium lies, for one more.

    Raises:
        Trial: the page reported an error.
    """

    async def together() -> tuple[int, list[str]]:
        sampler = asyncio.create_task(viewer.sampled())
        looks = [asyncio.create_task(b.look(viewer.address, seconds)) for b in browsers]
        real = _page.look(page, viewer.address, seconds) if page is not None else None
        found = (0, []) if real is None else await real
        await asyncio.gather(*looks)
        sampler.cancel()
        return found

    came, wrong = asyncio.run(together())
    if wrong:
        raise Trial(f"the page reported: {wrong[0]}")
    return came


def wait_for_programs(viewer: Viewer) -> None:
    """Wait until nothing is being compiled.

    Raises:
        Trial: that takes too long.
    """
    end = time.monotonic() + MOST_S
    while viewer.alive()["compiling"]:
        if time.monotonic() > end:
            raise Trial("the viewer compiles and compiles")
        time.sleep(1)


def everything_closed(viewer: Viewer) -> dict[str, int]:
    """Return what lives in the viewer once no browser is left, or what stays."""
    end = time.monotonic() + GONE_S
    while any((found := viewer.alive()).values()) and time.monotonic() < end:
        time.sleep(0.5)
    return found


def try_viewer(
    run: Path, out: Path, env: dict[str, str], seconds: float, slow_s: float, report: Report
) -> list[Check]:
    """Look at a run with eight browsers, then with one that reads nothing, and close all.

    Args:
        run: a finished run.
        out: an empty folder.
        env: of the viewer.
        seconds: for which eight browsers look.
        slow_s: for which one of eight reads nothing.
        report: receives progress.

    Raises:
        Trial: the viewer, or its page, breaks down.
    """
    chromium = _page.chromium()
    with opened(run, out, env) as viewer:
        report("load: the viewer is there")
        # Its programs are compiled, and the threads of its pool are there.
        wait_for_programs(viewer)
        for visit in range(VISITS):
            first = [Browser(k, rude=k % 2 == 1) for k in range(BROWSERS)]
            page = chromium if visit == 0 else None
            look_together(viewer, first, WARM_UP_S / (visit + 1), page)
            wait_for_programs(viewer)
        alive, before = everything_closed(viewer), viewer.held()
        report(f"load: {alive} {before}")

        begin = time.monotonic()
        clients = [Browser(k) for k in range(BROWSERS - (chromium is not None))]
        came = look_together(viewer, clients, seconds, chromium)
        early = [mb for at, mb in viewer.kept if begin < at <= begin + seconds / 10]
        late = [mb for at, mb in viewer.kept if at > begin + seconds * 0.9]
        latencies = np.array([s for b in clients for _, s in b.latencies])
        report(f"load: {len(latencies)} pictures, {np.median(latencies):.3f} s, {came} messages")

        # The same without the real page, which takes cores, with none slow and with one.
        fair = [Browser(k) for k in range(BROWSERS)]
        look_together(viewer, fair, slow_s, None)
        viewer.kept.clear()
        some = [Browser(k, reads=k > 0) for k in range(BROWSERS)]
        look_together(viewer, some, slow_s, None)
        beside_slow = [mb for _, mb in viewer.kept]
        report(f"load: one of {BROWSERS} read nothing, it was disconnected {some[0].lost} times")

        leaving = [Browser(k, rude=k % 2 == 1) for k in range(BROWSERS)]
        look_together(viewer, leaving, 5.0, None)
        left, after = everything_closed(viewer), viewer.held()
        report(f"load: {left} {after}")

    def percentile(browsers: list[Browser], share: float) -> float:
        found = [s for b in browsers for _, s in b.latencies]
        return float(np.percentile(found, share)) if found else np.inf

    pictures = [len(b.latencies) for b in clients]
    checks = [
        Check("viewer: browsers that got no picture", pictures.count(0), 0, ""),
        Check("viewer: connections that it closed", sum(b.lost for b in clients), 0, ""),
        Check("viewer: pictures a second, all browsers", sum(pictures) / seconds, None, "1/s"),
        Check("viewer: latency, median", percentile(clients, 50), None, "s"),
        Check("viewer: latency, 95 %", percentile(clients, 95), None, "s"),
        Check("viewer: latency, 99 %", percentile(clients, 99), 5.0, "s"),
        Check(
            "viewer: memory, last tenth above first",
            float(np.median(late) - np.median(early)),
            GROWN_MB,
            "MB",
        ),
        Check("viewer: memory, most", max(mb for mb in (*early, *late)), None, "MB"),
        Check(
            "viewer: one of 8 reads nothing, 95 % latency of the others",
            percentile(some[1:], 95) / percentile(fair[1:], 95),
            SLOWER,
            "times",
        ),
        Check(
            "viewer: one of 8 reads nothing, memory",
            beside_slow[-1] - beside_slow[0],
            GROWN_MB,
            "MB",
        ),
        Check("viewer: pages closed, memory left", after.mb - before.mb, LEFT_MB, "MB"),
        Check("viewer: pages closed, files left", after.files - before.files, 0, ""),
    ]
    for kind, count in left.items():
        checks.append(Check(f"viewer: pages closed, {kind} left", count - alive[kind], 0, ""))
    if chromium is not None:
        checks.append(Check("viewer: messages that a real page received", came, None, ""))
    return checks
