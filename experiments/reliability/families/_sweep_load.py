"""A sweep whose runs fail by the tenth: refused, or killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Collection
from pathlib import Path

from reliability.families._checks import Check
from reliability.families._processes import processes_with
from reliability.families._scenes import SMALLEST_FIT
from reliability.family import Report

from p2gs_jax.jobs.job import slug

# Every tenth run fails, by turns refused and killed.
EVERY = 10
LOOK_S = 0.05
MOST_S_A_RUN = 120.0


class Killer:
    """Kills the processes of some runs: of some at every try, of others once.

    Args:
        always: names of runs.
        once: likewise.
    """

    def __init__(self, always: Collection[str], once: Collection[str]):
        self.always, self.left = set(always), set(once)
        self.kills = 0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work)

    def __enter__(self) -> Killer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._end.wait(LOOK_S):
            for name in (*self.always, *self.left):
                for pid in processes_with(f"/{slug(f'{name}, seed 0')}.json"):
                    os.kill(pid, signal.SIGKILL)
                    self.kills += 1
                    self.left.discard(name)


def try_sweep(
    scene: Path, out: Path, env: dict[str, str], count: int, report: Report
) -> list[Check]:
    """Sweep with a tenth of the runs failing, and as many killed once.

    Args:
        scene: to fit.
        out: an empty folder.
        env: of the sweep.
        count: of runs.
        report: receives progress.
    """
    names = [f"run {k}" for k in range(count)]
    failing = names[EVERY - 1 :: EVERY]
    # Exposures are asked of photographs that say none.
    refused, killed = failing[::2], failing[1::2]
    once = names[EVERY // 2 :: EVERY]
    file = out / "sweep.toml"
    file.write_text(_toml(scene, out / "runs", names, refused))
    argv = [sys.executable, "-m", "p2gs_jax.cli", "sweep", str(file)]
    with Killer(killed, once) as killer:
        ended = subprocess.run(
            argv, env=env, capture_output=True, text=True, timeout=MOST_S_A_RUN * count
        )
    report(f"load: the sweep ended with {ended.returncode}, {killer.kills} kills")
    rows = {row["name"]: row for row in json.loads((out / "runs" / "sweep.json").read_text())}
    table = (out / "runs" / "sweep.md").read_text()
    why = dict.fromkeys(refused, "exif") | dict.fromkeys(killed, "SIGKILL")
    wrong = [n for n in names if (rows[n]["status"] == "failed") != (n in failing)]
    for name in wrong:
        report(f"load: {name}: {rows[name]['status']}: {rows[name].get('reason', '')}")
    unsaid = [n for n in failing if why[n].lower() not in str(rows[n].get("reason")).lower()]
    lines = [f"{n}, seed 0: failed" for n in failing]
    unnamed = [x for x in lines if x not in table or x not in " ".join(ended.stdout.split())]
    for name in (*unsaid, *unnamed):
        report(f"load: {name}: {rows[name]['reason'] if name in rows else 'not in the table'}")
    left = processes_with(str(out / "runs" / "jobs"))
    return [
        Check(f"sweep of {count}: runs that fail", len(failing), None, ""),
        Check(f"sweep of {count}: runs killed once, that go on", len(once), None, ""),
        Check(f"sweep of {count}: runs that ended otherwise", len(wrong), 0, ""),
        Check(f"sweep of {count}: failures without their reason", len(unsaid), 0, ""),
        Check(f"sweep of {count}: failures that the table does not name", len(unnamed), 0, ""),
        Check(f"sweep of {count}: exit code, away from 1", abs(ended.returncode - 1), 0, ""),
        Check(f"sweep of {count}: tracebacks", ended.stderr.count("Traceback"), 0, ""),
        Check(f"sweep of {count}: processes left behind", len(left), 0, ""),
    ]


def _toml(scene: Path, out: Path, names: list[str], refused: list[str]) -> str:
    """Return the file of the sweep."""
    lines = [f'scene = "{scene}"', f'out = "{out}"']
    lines += [f"max_parallel = {max(os.cpu_count() or 1, 1)}", "[set]"]
    lines += [f'"{name}" = {json.dumps(value)}' for name, value in SMALLEST_FIT.items()]
    for number, name in enumerate(names):
        lines += ["[[case]]", f'name = "{name}"', f'"train.checkpoint_every_s" = {600 + number}']
        if name in refused:
            lines.append('"photometry.known" = "exif"')
    return "\n".join(lines) + "\n"
