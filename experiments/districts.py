"""A town in blocks against the same town in one fit: held-out views, seams, peak memory.

python experiments/districts.py [--quick] [--out DIR]

Streets one behind another, photographed by three cameras: 300 photographs each over 600 m (quick:
30 over 60 m), in four blocks (quick: two), one after another. Every fit has a process of its own,
so that its peak memory is its own. Finished runs are kept.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from towns import table

from p2gs_jax import write_street
from p2gs_jax.synth.sensor import Sensor
from p2gs_jax.synth.settings import image_height

PEAK = re.compile(r"VmHWM:\s+(\d+)")


@dataclasses.dataclass(frozen=True)
class Size:
    """How large everything is."""

    frames: int  # of each of three cameras
    step_m: float  # between them
    width: int  # of the photographs, pixels
    points: int  # sampled for the model
    steps: int  # of one fit; blocks take their shares
    blocks: int

    @property
    def name(self) -> str:
        """Folder of its data and runs."""
        return f"{3 * self.frames}x{self.width}_{self.steps}"


FULL = Size(300, 2.0, 320, 200_000, 6_000, 4)
QUICK = Size(30, 2.0, 96, 12_000, 400, 2)


def main() -> None:
    """Make the town, fit it both ways, print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/districts"))
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    size = QUICK if args.quick else FULL
    folder = args.out / size.name
    town = folder / "town"
    if not town.exists():
        write_street(
            town,
            frames=size.frames,
            step=size.step_m,
            width=size.width,
            height=image_height(size.width),
            points=size.points,
            supersample=4,
            sensor=Sensor(iso_std=2.0),
            layout="long",
            matte=True,
            report=lambda line: print(line, flush=True),
        )
    blocks = fitted(town, folder / "blocks", size, ["--blocks", str(size.blocks)])
    one = fitted(town, folder / "one", size, [])
    rows = [row("one fit", one), row(f"{size.blocks} blocks", blocks)]
    print(table(HEADER, rows))
    print(seams(blocks))


HEADER = (
    *("run", "held-out dB", "training dB", "Gaussians", "peak memory of a fit, GB"),
    *("of merging and judging, GB", "seconds"),
)


def fitted(town: Path, run: Path, size: Size, words: list[str]) -> dict[str, Any]:
    """Return the `metrics.json` of a run and the peak memory of its process; both are kept."""
    said = run / "metrics.json"
    kept = run / "peak.json"
    if not kept.exists():
        command = [sys.executable, "-m", "p2gs_jax.cli", "fit", str(town), "--out", str(run)]
        command += ["--steps", str(size.steps), *words]
        command += ["--resume"] if (run / "config.json").exists() else []
        begin = time.monotonic()
        peak = watched(command)
        seconds = time.monotonic() - begin
        kept.write_text(json.dumps({"peak_bytes": peak, "wall_s": seconds}))
    return json.loads(said.read_text()) | json.loads(kept.read_text())


def watched(command: list[str]) -> int:
    """Run a command; return the most memory that it held, without that of its children.

    Raises:
        CalledProcessError: it failed.
    """
    process, peak = subprocess.Popen(command), 0
    while process.poll() is None:
        with contextlib.suppress(OSError):
            found = PEAK.search(Path(f"/proc/{process.pid}/status").read_text())
            peak = max(peak, int(found.group(1)) * 1024 if found else 0)
        time.sleep(0.2)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return peak


def row(name: str, run: dict[str, Any]) -> list[str]:
    """Return the cells of a run."""
    blocks = run.get("districts", {}).get("blocks")
    fit = run["peak_bytes"] if blocks is None else max(b["peak_bytes"] for b in blocks)
    return [
        name,
        f"{run['test']['exposure_fitted']['psnr']:.2f}",
        f"{run['train']['psnr']:.2f}",
        str(run["counts"]["gaussians"]),
        f"{fit / 1e9:.2f}",
        "" if blocks is None else f"{run['peak_bytes'] / 1e9:.2f}",
        f"{run['wall_s']:.0f}",
    ]


FIGURES = ("levelled_stops", "step_stops", "spread_stops", "step_depth", "spread_depth")


def seams(run: dict[str, Any]) -> str:
    """Return the table of seams of a run in blocks."""
    rows = []
    for seam in run["districts"]["seams"]:
        values = [seam[k] for k in FIGURES]
        cells = ["n/a" if v is None else f"{v:.4f}" for v in values]
        rows.append([" and ".join(map(str, seam["blocks"])), str(seam["pixels"]), *cells])
    header = (
        *("seam", "pixels", "step levelled, stops", "step left, stops", "spread, stops"),
        *("step of depth", "spread of depth"),
    )
    return table(header, rows)


if __name__ == "__main__":
    main()
