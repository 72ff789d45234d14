"""Memory and time of the photographs of a fit, for 300, 1000 and 3000 of them.

python experiments/many_photographs.py [--counts 300 1000 3000] [--against DIR] [--cache-mb 512]

Photographs are made (JPEG of noise and shapes). A process goes through them as a fit does: all at
full size once, as the photometry does, then two epochs in the order of the steps, with the level of
a coarse start in the first. It reports its own memory, apart from pages of mapped files, which the
system may drop at any time; processor seconds of it and its processes; and seconds. With
`--against`, another checkout does the same, in turn.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

SIZE = (640, 360)
ROUNDS = 3

WALK = """
import json, resource, sys, threading, time
from pathlib import Path
import numpy as np
from p2gs_jax.config import DataConfig
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.train.views import TrainingViews
from p2gs_jax.types import View

def memory():
    rows = dict(line.split(":", 1) for line in open("/proc/self/status") if line.startswith("Rss"))
    return {k: int(v.split()[0]) / 1024 for k, v in rows.items()}

folder, width, height, cache_mb, work = Path(sys.argv[1]), *map(int, sys.argv[2:5]), sys.argv[5]
K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], np.float32)
pose = np.eye(4, dtype=np.float32)
paths = sorted(folder.glob("*.jpg"))[: int(sys.argv[6])]
views = [View(p.name, p, "0", pose, K, width, height) for p in paths]
peak, stop = {"RssAnon": 0.0, "RssFile": 0.0}, threading.Event()
before = memory()

def watch():
    while not stop.wait(0.02):
        now = memory()
        for name in peak:
            peak[name] = max(peak[name], now[name] - before[name])

threading.Thread(target=watch, daemon=True).start()
cfg = DataConfig(cache_mb=cache_mb)
started = time.process_time()
begin = time.monotonic()
try:
    store = ImageStore(views, cfg, folder=Path(work))
except TypeError:
    store = ImageStore(views, cfg)
if hasattr(store, "expect"):
    store.expect((2, 1))
seconds, total = {}, 0
for row in range(len(views)):
    total += int(store.stored(row)[0][::64, ::64].sum())
seconds["photometry"] = time.monotonic() - begin
batches = TrainingViews(store, range(len(views)), 0)
step = 0
for epoch, shrink in (("coarse epoch", 2), ("epoch", 1), ("next epoch", 1)):
    begin = time.monotonic()
    for _ in views:
        batches.prefetch(batches.index_at(step + 1), shrink)
        batch = batches.batch(batches.index_at(step), shrink)
        total += int(np.asarray(batch.ldr).sum())
        step += 1
    seconds[epoch] = time.monotonic() - begin
stop.set()
store.close()
used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
busy = sum(u.ru_utime + u.ru_stime for u in used) - started
found = {"own_mb": peak["RssAnon"], "mapped_mb": peak["RssFile"], "busy_s": busy}
print(json.dumps(found | {"seconds": seconds, "sum": total}))
"""


def make_photographs(folder: Path, count: int) -> None:
    """Write photographs, those that are not there yet."""
    import cv2
    import numpy as np

    rng = np.random.default_rng(0)
    width, height = SIZE
    ground = cv2.resize(rng.integers(0, 256, (45, 80, 3), np.uint8), SIZE)
    for k in range(count):
        path = folder / f"{k:05d}.jpg"
        if path.exists():
            continue
        image = np.roll(ground, (7 * k) % width, axis=1)
        for _ in range(12):
            x, y, r = rng.integers(0, (width, height, 60))
            cv2.circle(image, (int(x), int(y)), int(r), rng.integers(0, 256, 3).tolist(), -1)
        cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 90])


def walked(checkout: Path, folder: Path, count: int, cache_mb: int) -> dict:
    """Return what a process of a checkout reports."""
    with tempfile.TemporaryDirectory(dir=folder) as work:
        words = [*map(str, (folder, *SIZE, cache_mb)), f"{work}/pixels", str(count)]
        done = subprocess.run(
            [sys.executable, "-c", WALK, *words],
            # Of `-c` the working folder comes first in the path of modules.
            cwd=checkout,
            env=os.environ | {"PYTHONPATH": str(checkout), "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
            check=True,
        )
    return json.loads(done.stdout)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[300, 1000, 3000])
    parser.add_argument("--against", type=Path)
    parser.add_argument("--cache-mb", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    given = parser.parse_args()
    checkouts = {"now": Path(__file__).parents[1]}
    if given.against is not None:
        checkouts = {"before": given.against, **checkouts}
    parts = ("photometry", "coarse epoch", "epoch", "next epoch")
    print(f"| photographs | | own MB | mapped MB | processor s | {' s | '.join(parts)} s |")
    print(f"|{'---|' * (5 + len(parts))}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for count in given.counts:
            make_photographs(folder, count)
            rows: dict[str, list[dict]] = {name: [] for name in checkouts}
            for _ in range(given.rounds):
                for name, checkout in checkouts.items():
                    rows[name].append(walked(checkout, folder, count, given.cache_mb))
            assert len({row["sum"] for found in rows.values() for row in found}) == 1
            for name, found in rows.items():
                own, mapped = (max(r[key] for r in found) for key in ("own_mb", "mapped_mb"))
                busy = min(r["busy_s"] for r in found)
                times = [min(r["seconds"][part] for r in found) for part in parts]
                said = " | ".join(f"{t:.1f}" for t in times)
                print(
                    f"| {count} | {name} | {own:.0f} | {mapped:.0f} | {busy:.0f} | {said} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
