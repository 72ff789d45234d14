"""Many fits in one process: `python _many_fits.py SCENES OUT COUNT`, a line of JSON after each.

Scenes take turns, and every fit has a seed of its own. The last run stays.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from reliability.families._processes import held
from reliability.families._scenes import SMALLEST_FIT

from p2gs_jax import fit, preset, with_fields
from p2gs_jax.core.clock import CompileCounter


def main(scenes: list[Path], out: Path, count: int) -> None:
    """Fit so many times, and say after each what the process holds."""
    cfg = with_fields(preset("robust"), SMALLEST_FIT)
    for number in range(count):
        compiler, begin = CompileCounter(), time.perf_counter()
        seeded = dataclasses.replace(cfg, train=dataclasses.replace(cfg.train, seed=number))
        fit(scenes[number % len(scenes)], out / str(number), seeded)
        seconds = time.perf_counter() - begin
        if number + 1 < count:
            shutil.rmtree(out / str(number))
        said = dataclasses.asdict(held()) | {"seconds": seconds, "compiled": compiler.programs}
        print(json.dumps(said), flush=True)


if __name__ == "__main__":
    main([Path(scene) for scene in sys.argv[1].split(",")], Path(sys.argv[2]), int(sys.argv[3]))
