"""A task of jobs; processes of a test find it through PYTHONPATH."""

import os
import signal
import time

from p2gs_jax.errors import UserError


def count(folder, arguments, reporter):
    """Count starts in the file `tries`; do `first` in `until` starts (default 1), then succeed."""
    folder.mkdir(parents=True, exist_ok=True)
    tries = folder / "tries"
    with tries.open("a") as file:
        file.write("x")
    starts = tries.stat().st_size
    reporter.stage("Counting", starts, 4)
    todo = arguments.get("first")
    if todo is None or starts > arguments.get("until", 1):
        (folder / "done").touch()
    elif todo == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif todo == "fill":
        raise MemoryError("of the job")
    elif todo == "terminate":
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(120)
    elif todo == "refuse":
        raise UserError("the scene is empty.", fix="add photographs")
    elif todo == "stumble":
        raise ZeroDivisionError("by zero")
    elif todo == "leave":
        print("last words", flush=True)
        os._exit(3)
    elif todo == "wait":
        time.sleep(120)
