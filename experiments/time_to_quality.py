"""Quality against wall seconds of the whole command, for this checkout and another one.

python experiments/time_to_quality.py SCENE... --against DIR [--budgets 60 120] [--max-width 480]

Every row is one `python -m p2gs_jax.cli fit ... --budget` with an empty compile cache, from the
start of the interpreter to its end; the two versions take turns. Rows are kept in --out, and the
same command goes on where it was interrupted. A row belongs to the code that it was measured with
(the tree of `p2gs_jax` in git, and uncommitted changes in it).
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from checkout import commit, git
from mixtures import read_groups, within_groups_ev
from towns import ISO8

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.text import markdown_table, value_at
from p2gs_jax.evaluation.alignment import error_of_views
from p2gs_jax.synth.sensor import read_true_exposures

HERE = Path(__file__).resolve().parents[1]
THIS, AGAINST = "this", "against"


class Version(NamedTuple):
    """A checkout."""

    label: str  # `this` or `against`
    root: Path
    commit: str
    code: str  # hash of its `p2gs_jax`; rows are kept by it


class Job(NamedTuple):
    """One point of a curve."""

    scene: Path
    version: Version
    budget: int

    def of(self, row: Mapping[str, Any]) -> bool:
        """Return whether a row was measured for this job."""
        keys = (row["scene"], row["version"], row["code"], row["budget"])
        return keys == (self.scene.name, self.version.label, self.version.code, self.budget)


def version(label: str, root: Path) -> Version:
    """Return the version that a folder has checked out."""
    if not (root / "p2gs_jax" / "cli").is_dir():
        raise SystemExit(f"{root} is not a checkout of p2gs-jax.")
    code = git(root, "rev-parse", "--short=10", "HEAD:p2gs_jax")
    if changed := git(root, "diff", "HEAD", "--", "p2gs_jax"):
        code += "+" + hashlib.sha256(changed.encode()).hexdigest()[:6]
    return Version(label, root, commit(root), code)


def execute(job: Job, words: Sequence[str], work: Path) -> dict[str, Any]:
    """Run a fit and return its row.

    Raises:
        RuntimeError: the fit failed; with the end of its output.
    """
    with tempfile.TemporaryDirectory(dir=work) as temporary:
        out = Path(temporary) / "run"
        command = [sys.executable, "-m", "p2gs_jax.cli", "fit", str(job.scene)]
        command += ["--out", str(out), "--budget", f"{job.budget}s", *words]
        if (job.scene / "reference").is_dir():
            command += ["--reference", str(job.scene / "reference")]
        kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION_CACHE")}
        kept |= {"PYTHONPATH": str(job.version.root), "XDG_CACHE_HOME": f"{temporary}/cache"}
        before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        done = subprocess.run(
            command, cwd=job.version.root, env=kept, capture_output=True, text=True, check=False
        )
        wall, after = time.monotonic() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode:
            raise RuntimeError((done.stdout + done.stderr)[-2000:])
        metrics = json.loads((out / "metrics.json").read_text())
        photometry = json.loads((out / "photometry.json").read_text())
    truth, groups = read_true_exposures(job.scene), read_groups(job.scene)
    error = error_of_views(photometry.get("views", ()), truth)
    return {
        "scene": job.scene.name,
        "version": job.version.label,
        "commit": job.version.commit,
        "code": job.version.code,
        "budget": job.budget,
        "date": datetime.datetime.now().isoformat(timespec="seconds"),
        "wall_s": round(wall, 2),
        "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "steps": value_at(metrics, ("counts", "steps")),
        "gaussians": value_at(metrics, ("counts", "gaussians")),
        "test_psnr": value_at(metrics, ("test", "exposure_fitted", "psnr")),
        "reference_test_psnr": value_at(metrics, (*ISO8, "test", "psnr")),
        "ev": within_groups_ev(photometry, groups) if groups else value_at(error, ("ev",)),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as a Markdown table."""
    columns = {"wall_s": 1, "cpu_s": 1, "steps": 0, "gaussians": 0}
    columns |= {"test_psnr": 2, "reference_test_psnr": 2, "ev": 4}
    cells = [
        [r["scene"], str(r["budget"]), f"{r['version']} ({r['commit']})"]
        + [f"{r[c]:.{n}f}" if r.get(c) is not None else "n/a" for c, n in columns.items()]
        for r in rows
    ]
    return markdown_table(("scene", "budget s", "version", *columns), cells) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, nargs="+", help="scene folders")
    parser.add_argument("--against", type=Path, required=True, help="another checkout")
    parser.add_argument("--budgets", type=int, nargs="+", default=[60, 120, 240, 480])
    parser.add_argument("--max-width", help="of the photographs, pixels")
    parser.add_argument("--work", type=Path, default=Path("runs/time_to_quality"))
    parser.add_argument("--out", type=Path, default=Path("runs/time_to_quality.json"))
    args = parser.parse_args()
    work = args.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    versions = [version(THIS, HERE), version(AGAINST, args.against.resolve())]
    words = ["--max-width", args.max_width] if args.max_width else []
    jobs = [
        Job(s.resolve(), v, b) for s in args.scenes for b in sorted(args.budgets) for v in versions
    ]
    rows = json.loads(args.out.read_text()) if args.out.is_file() else []
    for job in jobs:
        if not any(job.of(row) for row in rows):
            rows.append(execute(job, words, work))
            write_json(args.out, rows)
            print(table(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    # Rows of other code stay in the file; the table shows these two versions.
    shown = [row for job in jobs for row in rows if job.of(row)]
    print(table(shown))


if __name__ == "__main__":
    main()
