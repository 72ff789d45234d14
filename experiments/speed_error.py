"""Milliseconds against error over every knob of the renderer, at full size.

python experiments/speed_error.py --out runs/bench

The same as `p2gs-jax bench speed_error`; `--quick` ends in a minute.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from p2gs_jax.bench.run import run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    text, _ = run(
        ("speed_error",),
        out=args.out,
        quick=args.quick,
        on_progress=lambda stage, done, count: print(f"{stage} {done}/{count}", flush=True),
    )
    print(text)


if __name__ == "__main__":
    main()
