"""Quality against wall seconds of the whole command, for this checkout and another one.

python experiments/time_to_quality.py --against DIR [--quick] [--scenes town sofa]

Every point is one `python -m p2gs_jax.cli fit ... --budget`, from the start of the interpreter to
its end: the budgets differ, the versions take turns. Cold runs start with an empty cache folder,
warm ones with the programs that earlier runs of the same version and scene left. Rows are kept in
--out; run again to go on. A row belongs to the code it was measured with (the tree of `p2gs_jax` in
git, and what is not committed in it), so another commit of the same code keeps it.

The cache folder is given as XDG_CACHE_HOME, not as JAX_COMPILATION_CACHE_DIR, under which the
program leaves JAX's own rule of what is worth keeping: each version then keeps what it keeps for
its users.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import hashlib
import itertools
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from mixtures import read_groups, within_groups_ev, write_mixture

from p2gs_jax.core.atomic import atomic_write, write_json
from p2gs_jax.evaluate.alignment import exposure_error
from p2gs_jax.synth.exposures import read_true_exposures
from p2gs_jax.synth.rig import image_height
from p2gs_jax.synth.sensor import Sensor
from p2gs_jax.synth.write import write_street

HERE = Path(__file__).resolve().parents[1]
Temperature = Literal["cold", "warm"]
BUDGETS = (60, 120, 240, 480)
QUICK_BUDGET = 30
THIS, AGAINST = "this", "against"
TICKS = (15, 20, 30, 45, 60, 90, 120, 180, 240, 360, 480, 720, 960)
COLORS = {THIS: "#0072B2", AGAINST: "#D55E00"}
COMPILED = re.compile(r"Finished XLA compilation of \S+ in ([\d.]+) sec")


# ------------------------------------------------------------------ versions and scenes


@dataclass(frozen=True)
class Version:
    """A checkout.

    Attributes:
        label: `this` or `against`.
        root: its folder.
        commit: what is checked out, for readers.
        code: hash of its `p2gs_jax`; rows are kept by it.
    """

    label: str
    root: Path
    commit: str
    code: str


def version(label: str, root: Path) -> Version:
    """Return what a folder has checked out."""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False
        )
        return done.stdout.strip()

    if not (root / "p2gs_jax" / "cli").is_dir():
        raise SystemExit(f"{root} is no checkout of p2gs-jax.")
    tree = git("rev-parse", "--short=10", "HEAD:p2gs_jax") or "unknown"
    changed = git("diff", "HEAD", "--", "p2gs_jax")
    commit = git("rev-parse", "--short", "HEAD") or "unknown"
    if changed:
        tree += "+" + hashlib.sha256(changed.encode()).hexdigest()[:6]
        commit += " and changes"
    return Version(label, root, commit, tree)


class SceneToFit(NamedTuple):
    """A scene and the options that belong to it.

    Attributes:
        name: what tables call it.
        folder: of the scene.
        options: of `fit`.
    """

    name: str
    folder: Path
    options: tuple[str, ...] = ()


def _town(work: Path, *, quick: bool) -> SceneToFit:
    frames, width, points = (6, 128, 3000) if quick else (30, 480, 60_000)
    folder = work / "scenes" / f"town_3_{width}x{image_height(width)}_{frames}x3"
    if not folder.exists():
        write_street(
            folder,
            frames=frames,
            width=width,
            height=image_height(width),
            points=points,
            sensor=Sensor(iso_std=4.0),
            seed=3,
            layout="town",
            report=lambda line: print(line, file=sys.stderr, flush=True),
        )
    # The quick town's runs are not to be mistaken for the town's.
    name = "town, small" if quick else "town"
    return SceneToFit(name, folder, ("--reference", str(folder / "reference")))


def _sofa(work: Path, lom: Path, script: Path | None) -> SceneToFit:
    folder = work / "scenes" / "sofa"
    if not folder.exists():
        if script is None:
            write_mixture(lom, folder)
        else:
            subprocess.run([sys.executable, script, lom, folder], check=True)
    return SceneToFit("sofa", folder, ("--reference", str(folder / "reference")))


SCENES = ("town", "nerf_fox", "sofa", "sceaux_castle")


def scenes(
    names: Sequence[str], work: Path, data: Path, mixture: Path | None, *, quick: bool
) -> list[SceneToFit]:
    """Return the scenes that are there; those that are not are named on stderr.

    Args:
        names: of `SCENES`.
        work: where scenes are made.
        data: folder of captures.
        mixture: script that writes the mixture of exposures; None writes it here.
        quick: the small town.
    """
    found = []
    needs = {"nerf_fox": "nerf_fox", "sofa": "lom_sofa", "sceaux_castle": "sceaux_castle"}
    for name in names:
        source = data / needs.get(name, "")
        if name in needs and not source.is_dir():
            print(f"{name} is skipped: there is no {source}", file=sys.stderr, flush=True)
        elif name == "town":
            found.append(_town(work, quick=quick))
        elif name == "sofa":
            found.append(_sofa(work, source, mixture))
        else:
            width = ("--max-width", "480") if name == "nerf_fox" else ()
            found.append(SceneToFit(name, source, width))
    return found


# ------------------------------------------------------------------ one run


class Job(NamedTuple):
    """One point of a curve.

    Attributes:
        scene: what is fitted.
        version: by which code.
        temperature: with programs kept from earlier runs, or without.
        budget: seconds given to `fit`.
    """

    scene: SceneToFit
    version: Version
    temperature: Temperature
    budget: int

    @property
    def key(self) -> dict[str, Any]:
        """What tells its row from all others."""
        # Absolute folders are left out of the options: the row belongs to the scene's name.
        options = [o for o in self.scene.options if not Path(o).is_absolute()]
        return {
            "scene": self.scene.name,
            "options": options,
            "code": self.version.code,
            "temperature": self.temperature,
            "budget": self.budget,
        }


def plan(
    found: Sequence[SceneToFit],
    versions: Sequence[Version],
    temperatures: Sequence[Temperature],
    budgets: Sequence[int],
) -> list[Job]:
    """Return all jobs; the versions take turns, and cold runs come before warm ones.

    The longest budget comes first: its cold run leaves what the warm ones need.
    """
    order: list[Temperature] = [t for t in ("cold", "warm") if t in temperatures]
    return [
        Job(scene, v, temperature, budget)
        for scene in found
        for budget in sorted(budgets, reverse=True)
        for temperature in order
        for v in versions
    ]


def missing(jobs: Sequence[Job], rows: Sequence[Mapping[str, Any]]) -> list[Job]:
    """Return the jobs that have no row; two versions of the same code need only one each."""
    return [job for job in jobs if row_of(job, rows) is None]


def row_of(job: Job, rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return a job's row, or None."""
    wanted = {**job.key, "version": job.version.label}
    return next((r for r in rows if all(r.get(k) == v for k, v in wanted.items())), None)


def at(values: Any, *path: str) -> float | None:
    """Return a value of nested mappings, or None where there is none."""
    for key in path:
        values = values.get(key) if isinstance(values, Mapping) else None
    return values if isinstance(values, int | float) else None


def quality(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """Return what a run's metrics.json says of its quality.

    `reference_*` are held-out and training views against photographs of one common exposure, under
    one scalar for all of them.
    """
    return {
        "steps": at(metrics, "counts", "steps"),
        "gaussians": at(metrics, "counts", "gaussians"),
        "train_psnr": at(metrics, "train", "psnr"),
        "test_psnr": at(metrics, "test", "exposure_fitted", "psnr"),
        "reference_test_psnr": at(metrics, "reference", "scale_aligned", "test", "psnr"),
        "reference_train_psnr": at(metrics, "reference", "scale_aligned", "train", "psnr"),
    }


def true_ev(photometry: Mapping[str, Any], truth: Mapping[str, float]) -> float | None:
    """Return the error of exposures, RMS in stops, after one common scale; None without truth.

    Args:
        photometry: a run's photometry.json.
        truth: image name -> true exposure.
    """
    pairs = [
        (2.0 ** view["exposure_ev"], truth[view["image"]])
        for view in photometry.get("views", ())
        if view["exposure_ev"] is not None and view["image"] in truth
    ]
    return exposure_error(*np.array(pairs).T)["ev"] if pairs else None


def compiling(output: str) -> tuple[int, float]:
    """Return how many programs XLA compiled or read from the cache, and the seconds of that."""
    seconds = [float(s) for s in COMPILED.findall(output)]
    return len(seconds), round(sum(seconds), 1)


def environment(root: Path, cache: Path, fonts: Path) -> dict[str, str]:
    """Return the environment of a run: that checkout's code, that cache, nothing kept elsewhere.

    Args:
        root: the checkout.
        cache: user's cache folder.
        fonts: matplotlib's own cache, which is no business of the compiler's.
    """
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_COMPILATION_CACHE")}
    kept.pop("JAX_ENABLE_COMPILATION_CACHE", None)
    return kept | {
        "PYTHONPATH": str(root),
        "XDG_CACHE_HOME": str(cache),
        "MPLCONFIGDIR": str(fonts),
        "JAX_LOG_COMPILES": "1",
    }


def execute(job: Job, cache: Path, work: Path) -> dict[str, Any]:
    """Run a fit and return its row.

    Raises:
        RuntimeError: it failed; with the end of what it said.
    """
    fonts = work / "fonts"
    fonts.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work) as temporary:
        out = Path(temporary) / "run"
        command = [sys.executable, "-m", "p2gs_jax.cli", "fit", str(job.scene.folder)]
        command += ["--out", str(out), "--budget", f"{job.budget}s", *job.scene.options]
        load, before = os.getloadavg()[0], resource.getrusage(resource.RUSAGE_CHILDREN)
        begin = time.monotonic()
        done = subprocess.run(
            command,
            cwd=job.version.root,
            env=environment(job.version.root, cache, fonts),
            capture_output=True,
            text=True,
            check=False,
        )
        wall = time.monotonic() - begin
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        said = done.stdout + done.stderr
        if done.returncode:
            raise RuntimeError(said[-2000:])
        metrics = json.loads((out / "metrics.json").read_text())
        photometry = json.loads((out / "photometry.json").read_text())
        programs, compile_s = compiling(said)
        row = {
            "version": job.version.label,
            "commit": job.version.commit,
            **job.key,
            "date": datetime.datetime.now().isoformat(timespec="seconds"),
            "wall_s": round(wall, 2),
            "cpu_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
            "load_before": round(load, 1),
            "programs": programs,
            "compile_s": compile_s,
            **quality(metrics),
            "ev": true_ev(photometry, read_true_exposures(job.scene.folder)),
            "seconds": metrics.get("seconds"),
        }
        if groups := read_groups(job.scene.folder):
            row["ev_within_groups"] = within_groups_ev(photometry, groups)
        return row


@contextlib.contextmanager
def emptied(cache: Path) -> Iterator[Path]:
    """Yield an empty folder at `cache`; what it held before comes back beside what it then holds.

    The folder keeps its place because JAX's keys contain it: moved programs are not found.
    """
    aside = cache.with_name(f"{cache.name}.aside")
    if cache.is_dir() and not aside.is_dir():
        cache.rename(aside)
    shutil.rmtree(cache, ignore_errors=True)
    cache.mkdir(parents=True)
    try:
        yield cache
    finally:
        if aside.is_dir():
            shutil.copytree(aside, cache, dirs_exist_ok=True)
            shutil.rmtree(aside)


def run(job: Job, work: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Run a job with the cache that its temperature asks for.

    What a cold run compiled is kept for the warm ones; where nothing is kept yet, a warm run is
    preceded by one that does not count.
    """
    v = job.version
    cache = work / "caches" / f"{v.label}-{v.code}" / job.scene.name.replace(", ", "_")
    if job.temperature == "cold":
        with emptied(cache):
            return execute(job, cache, work)
    if not cache.is_dir():
        say("  first a run that does not count")
        with emptied(cache):
            execute(job, cache, work)
    return execute(job, cache, work)


# ------------------------------------------------------------------ what is made of the rows

HEADER = (
    "scene",
    "budget s",
    "version",
    "wall s",
    "compiling s",
    "programs",
    "steps",
    "Gaussians",
    "novel PSNR",
    "the same, common exposure",
    "EV error",
)


def _cell(value: float | None, digits: int) -> str:
    return "n/a" if value is None else f"{value:.{digits}f}"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as a Markdown table, in the order given."""
    lines = ["| " + " | ".join(HEADER) + " |", "|---|" + "---:|" * (len(HEADER) - 1)]
    for r in rows:
        ev = r.get("ev") if r.get("ev") is not None else r.get("ev_within_groups")
        cells = [
            f"{r['scene']}, {r['temperature']}",
            str(r["budget"]),
            f"{r['version']} ({r['commit']})",
            _cell(r["wall_s"], 1),
            _cell(r.get("compile_s"), 1),
            _cell(r.get("programs"), 0),
            _cell(r.get("steps"), 0),
            _cell(r.get("gaussians"), 0),
            _cell(r.get("test_psnr"), 2),
            _cell(r.get("reference_test_psnr"), 2),
            _cell(ev, 4),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


Curve = list[tuple[float, float]]


def curve(
    rows: Sequence[Mapping[str, Any]], scene: str, label: str, temperature: str, value: str
) -> Curve:
    """Return (wall seconds, value) of one line of the plot, by time."""
    return sorted(
        (r["wall_s"], r[value])
        for r in rows
        if (r["scene"], r["version"], r["temperature"]) == (scene, label, temperature)
        and r.get(value) is not None
    )


def seconds_to(points: Curve, level: float) -> float | None:
    """Return when a curve first reaches a level, linear in log time; None where it does not."""
    if not points:
        return None
    if points[0][1] >= level:
        return points[0][0]
    for (t0, v0), (t1, v1) in itertools.pairwise(points):
        if v1 >= level:
            part = (level - v0) / (v1 - v0)
            return float(np.exp(np.log(t0) + part * np.log(t1 / t0)))
    return None


def speedups(rows: Sequence[Mapping[str, Any]], value: str = "test_psnr") -> list[str]:
    """Return a sentence per scene and temperature: when this reaches what the other ends with."""
    said = []
    pairs = dict.fromkeys((r["scene"], r["temperature"]) for r in rows)
    for scene, temperature in pairs:
        ours, theirs = (curve(rows, scene, v, temperature, value) for v in (THIS, AGAINST))
        if not ours or not theirs:
            continue
        end, level = max(theirs, key=lambda point: point[1])
        begin = seconds_to(ours, level)
        where = f"{scene}, {temperature}: {level:.2f} dB, which the other reaches in {end:.0f} s"
        if begin is None:
            said.append(f"{where}, is not reached here (best {max(v for _, v in ours):.2f} dB)")
        else:
            first = "at most " if begin == ours[0][0] else ""
            said.append(
                f"{where}, takes {first}{begin:.0f} s here: {end / begin:.2f} times as fast"
            )
    return said


def plot(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Return held-out PSNR against wall seconds, one panel a scene."""
    names = list(dict.fromkeys(r["scene"] for r in rows))
    commits = {r["version"]: r["commit"] for r in rows}
    figure = Figure(figsize=(1.2 + 3.6 * max(len(names), 1), 4.0), layout="constrained")
    for axis, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
        for label, color in COLORS.items():
            for temperature, style, marker in (("cold", "--", "o"), ("warm", "-", "s")):
                points = curve(rows, name, label, temperature, "test_psnr")
                if points:
                    x, y = zip(*points, strict=True)
                    text = f"{label} ({commits[label]}), {temperature}"
                    filled = color if temperature == "warm" else "white"
                    axis.plot(x, y, style, marker=marker, mfc=filled, color=color, label=text, ms=5)
        times = sorted({r["budget"] for r in rows if r["scene"] == name})
        walls = [r["wall_s"] for r in rows if r["scene"] == name]
        axis.set(xscale="log", title=name, xlabel="wall seconds of the whole command")
        low, high = 0.8 * min([*times, *walls]), 1.25 * max([*times, *walls])
        axis.set_xlim(low, high)
        ticks = [t for t in TICKS if low <= t <= high] or times
        axis.set_xticks(ticks, [str(t) for t in ticks])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    figure.axes[0].set_ylabel("PSNR of held-out views, dB")
    handles = {
        text: handle
        for axis in figure.axes
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), fontsize=8, loc="outside lower center", ncols=2)
    return figure


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows that a file holds; none where it is missing."""
    return json.loads(path.read_text())["rows"] if path.is_file() else []


def write_rows(path: Path, stamp: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write all rows, whole or not at all."""
    write_json(path, {"stamp": dict(stamp), "rows": list(rows)})


# ------------------------------------------------------------------ command line


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, required=True, help="another checkout")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--budgets", type=int, nargs="+", default=list(BUDGETS))
    parser.add_argument(
        "--temperatures", nargs="+", choices=("cold", "warm"), default=["cold", "warm"]
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--mixture", type=Path, help="script that writes the sofa's mixture")
    parser.add_argument("--quick", action="store_true", help="the small town, one budget")
    parser.add_argument("--work", type=Path, default=Path("runs/time_to_quality"))
    parser.add_argument("--out", type=Path, help="JSON; the plot is written beside it")
    args = parser.parse_args()
    if args.quick:
        args.scenes = ["town"]
        args.budgets = args.budgets if tuple(args.budgets) != BUDGETS else [QUICK_BUDGET]
    today = datetime.date.today().isoformat()
    out = args.out or HERE / "experiments" / "results" / f"time_to_quality-{today}.json"
    work = args.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    versions = [version(THIS, HERE), version(AGAINST, args.against.resolve())]
    found = scenes(args.scenes, work, args.data.resolve(), args.mixture, quick=args.quick)
    jobs = plan(found, versions, args.temperatures, args.budgets)
    rows = read_rows(out)
    stamp = {
        "date": today,
        "command": "python experiments/time_to_quality.py",
        "versions": {v.label: {"commit": v.commit, "code": v.code} for v in versions},
        "options": {k: getattr(args, k) for k in ("scenes", "budgets", "temperatures", "quick")},
        "cores": len(os.sched_getaffinity(0)),
    }

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    failed = []
    todo = missing(jobs, rows)
    for i, job in enumerate(todo):
        what = f"{job.scene.name}, {job.temperature}, {job.budget} s, {job.version.label}"
        say(f"{i + 1}/{len(todo)} {what}")
        try:
            rows.append(run(job, work, say))
        except RuntimeError as error:
            failed.append(f"{what}: {error}")
            say(f"  failed: {error}")
            continue
        write_rows(out, stamp, rows)
        say(f"  {rows[-1]['wall_s']:.1f} s, novel {_cell(rows[-1]['test_psnr'], 2)} dB")
    # Rows of other code stay in the file; tables and plot are of these two versions.
    in_order = sorted(jobs, key=lambda j: (SCENES.index(j.scene.name.split(",")[0]), j.budget))
    shown = [row for row in (row_of(job, rows) for job in in_order) if row is not None]
    print(table(shown))
    for line in speedups(shown):
        print(f"- {line}")
    if shown:
        with atomic_write(out.with_suffix(".png")) as path:
            plot(shown).savefig(path, dpi=110, format="png")
    if failed:
        raise SystemExit(f"{len(failed)} runs failed; run again to try them again")


if __name__ == "__main__":
    main()
