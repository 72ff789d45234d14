"""Quality against wall seconds of the whole command, for this checkout and another one.

python experiments/time_to_quality.py --against DIR [--scenes town sofa] [--budgets 60 120]

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
from mixtures import read_groups, within_groups_ev, write_mixture

from p2gs_jax.core.atomic import write_json
from p2gs_jax.evaluation.alignment import error_of_views
from p2gs_jax.synth.sensor import Sensor, read_true_exposures
from p2gs_jax.synth.settings import image_height
from p2gs_jax.synth.write import write_street

HERE = Path(__file__).resolve().parents[1]
SCENES = ("town", "nerf_fox", "sofa", "sceaux_castle")
THIS, AGAINST = "this", "against"


class Version(NamedTuple):
    """A checkout."""

    label: str  # `this` or `against`
    root: Path
    commit: str
    code: str  # hash of its `p2gs_jax`; rows are kept by it


class SceneToFit(NamedTuple):
    """A scene, and the options of `fit` that belong to it."""

    name: str
    folder: Path
    options: tuple[str, ...] = ()


class Job(NamedTuple):
    """One point of a curve."""

    scene: SceneToFit
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


def scenes(names: Sequence[str], work: Path, data: Path) -> list[SceneToFit]:
    """Return the scenes that are there, made where they have to be; name others on stderr."""
    found = []
    sources = {"nerf_fox": "nerf_fox", "sofa": "lom_sofa", "sceaux_castle": "sceaux_castle"}
    for name in names:
        source, folder = data / sources.get(name, ""), work / "scenes" / name
        if name in sources and not source.is_dir():
            print(f"{name} is skipped: there is no {source}", file=sys.stderr)
            continue
        if name == "town" and not folder.exists():
            write_street(
                folder,
                frames=30,
                width=480,
                height=image_height(480),
                points=60_000,
                sensor=Sensor(iso_std=4.0),
                seed=3,
                layout="town",
                report=lambda line: print(line, file=sys.stderr),
            )
        if name == "sofa" and not folder.exists():
            write_mixture(source, folder)
        if name in ("town", "sofa"):
            found.append(SceneToFit(name, folder, ("--reference", str(folder / "reference"))))
        else:
            width = ("--max-width", "480") if name == "nerf_fox" else ()
            found.append(SceneToFit(name, source, width))
    return found


def at(values: Any, *path: str) -> float | None:
    """Return a value of nested mappings, or None where there is none."""
    for key in path:
        values = values.get(key) if isinstance(values, Mapping) else None
    return values if isinstance(values, int | float) else None


def execute(job: Job, work: Path) -> dict[str, Any]:
    """Run a fit and return its row.

    Raises:
        RuntimeError: the fit failed; with the end of its output.
    """
    with tempfile.TemporaryDirectory(dir=work) as temporary:
        out = Path(temporary) / "run"
        command = [sys.executable, "-m", "p2gs_jax.cli", "fit", str(job.scene.folder)]
        command += ["--out", str(out), "--budget", f"{job.budget}s", *job.scene.options]
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
    truth, groups = read_true_exposures(job.scene.folder), read_groups(job.scene.folder)
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
        "steps": at(metrics, "counts", "steps"),
        "gaussians": at(metrics, "counts", "gaussians"),
        "test_psnr": at(metrics, "test", "exposure_fitted", "psnr"),
        "reference_test_psnr": at(metrics, "reference", "scale_aligned", "test", "psnr"),
        "ev": within_groups_ev(photometry, groups) if groups else at(error or {}, "ev"),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as a Markdown table."""
    columns = {"wall_s": 1, "cpu_s": 1, "steps": 0, "gaussians": 0}
    columns |= {"test_psnr": 2, "reference_test_psnr": 2, "ev": 4}
    lines = ["| scene | budget s | version | " + " | ".join(columns) + " |"]
    lines.append("|---|---:|---|" + "---:|" * len(columns))
    for r in rows:
        cells = [f"{r[c]:.{n}f}" if r.get(c) is not None else "n/a" for c, n in columns.items()]
        first = [r["scene"], str(r["budget"]), f"{r['version']} ({r['commit']})"]
        lines.append("| " + " | ".join([*first, *cells]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, required=True, help="another checkout")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--budgets", type=int, nargs="+", default=[60, 120, 240, 480])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--work", type=Path, default=Path("runs/time_to_quality"))
    parser.add_argument("--out", type=Path, default=Path("runs/time_to_quality.json"))
    args = parser.parse_args()
    work = args.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    versions = [version(THIS, HERE), version(AGAINST, args.against.resolve())]
    found = scenes(args.scenes, work, args.data.resolve())
    jobs = [Job(s, v, b) for s in found for b in sorted(args.budgets) for v in versions]
    rows = json.loads(args.out.read_text()) if args.out.is_file() else []
    for job in jobs:
        if not any(job.of(row) for row in rows):
            rows.append(execute(job, work))
            write_json(args.out, rows)
            print(table(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    # Rows of other code stay in the file; the table shows these two versions.
    shown = [row for job in jobs for row in rows if job.of(row)]
    print(table(shown))


if __name__ == "__main__":
    main()
