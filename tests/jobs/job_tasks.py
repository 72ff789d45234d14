"""Tasks; processes of a test find them through PYTHONPATH."""

import os
import signal
import time

from p2gs_jax.errors import UserError


def count(folder, arguments, reporter):
    """Write how often it was begun; do as told the first time, and succeed after that."""
    folder.mkdir(parents=True, exist_ok=True)
    tries = folder / "tries"
    with tries.open("a") as file:
        file.write("x")
    times = tries.stat().st_size
    reporter.stage("Counting", times, arguments.get("of", 4))
    todo = arguments.get("first")
    if todo is None or times > arguments.get("until", 1):
        (folder / "done").touch()
    elif todo == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif todo == "fill":
        raise MemoryError("of the job")
    elif todo == "ask":
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
