"""Drives, and files of tables, cameras and runs, that are broken."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from reliability import scenes
from reliability.family import Family, Report
from reliability.mutations import Broken, cuts, flips, random_bytes, wrong_json, wrong_words
from reliability.reading import fit_into, read
from reliability.trials import REFUSED, Trial, in_child, run_trials

from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError
from p2gs_jax.paths.files import read_cameras
from p2gs_jax.run.read import load_run
from p2gs_jax.scene.exposures import check_source

NAME = "broken_drives"
ABOUT = """Drives of nuScenes, Argoverse 2, Waymo, PandaSet and KITTI, tables of
exposures, lists of cameras and the files of a finished run, each cut, flipped, out of range, empty
or gone, and tables whose names lead out of the drive. Each is read whole, or refused with code 2 by
a message that names file, fault and remedy, within 30 s and 2 GB."""
SEED = 20261125
SPACING = 5
DAMAGES = 12
TESTS = Path(__file__).resolve().parents[3] / "tests"
# Which of the tests' writers makes a small drive of each set.
WRITERS = {
    "nuscenes": "scene.drives.writers_nuscenes",
    "argoverse": "scene.drives.writers_argoverse",
    "waymo": "scene.drives.writers_waymo",
    "kitti_raw": "scene.drives.writers_kitti",
    "pandaset": "scene.drives.writers_pandaset",
}
RUN_FILES = ("config.json", "photometry.json", "decisions.json", "scene.npz", "radiance.ply")
# JAX starts in each of these children, and asks for address space that it does not use.
ADDRESSES = 8 * 2**30


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all; `quick`: every fifth."""
    found = [*trials(out / "made"), *_runs(out / "made")]
    return run_trials(NAME, found[:: SPACING if quick else 1], out, report)


def trials(made: Path) -> Iterator[Trial]:
    """Yield all but those of runs."""
    yield from _drives(made)
    yield from _ways_out(made)
    yield from _exposures()
    yield from _cameras()


def _drives(made: Path) -> Iterator[Trial]:
    sys.path.insert(0, str(TESTS))
    for number, (name, module) in enumerate(WRITERS.items()):
        whole = made / name
        whole.mkdir(parents=True)
        drive = importlib.import_module(module).write(whole / "set").root.relative_to(whole)
        files = sorted(
            p.relative_to(whole).as_posix()
            for p in whole.rglob("*")
            if p.is_file() and p.suffix not in (".png", ".jpg")
        )
        yield Trial(
            f"{name} whole", partial(_copied, whole, drive, None, None), read, refused=False
        )
        rng = np.random.default_rng(SEED + number)
        for _ in range(DAMAGES):
            place = files[int(rng.integers(len(files)))]
            broken = _damaged((whole / place).read_bytes(), rng)
            damaged = partial(_copied, whole, drive, place, broken)
            yield Trial(f"{name}, {place}: {broken.name}", damaged, read)
        for place in files[:: max(1, len(files) // 6)]:
            yield Trial(
                f"{name}, {place} is gone", partial(_copied, whole, drive, place, None), read
            )


def _ways_out(made: Path) -> Iterator[Trial]:
    """Yield tables of nuScenes that name files and cameras elsewhere; after `_drives`."""
    whole = made / "nuscenes"
    for table, old, news in (
        ("sample_data", b"samples/CAM_FRONT/", (b"../", b"/etc/", b"samples/../../")),
        ("sample_data", b"samples/LIDAR_TOP/", (b"../", b"/etc/")),
        ("sensor", b'"channel": "CAM_FRONT"', (b'"channel": "../../CAM"', b'"channel": "/CAM"')),
    ):
        place = f"set/v1.0-mini/{table}.json"
        data = (whole / place).read_bytes()
        for new in news:
            broken = Broken(f"{new.decode()} for {old.decode()}", data.replace(old, new))
            made_so = partial(_copied, whole, Path("set"), place, broken)
            yield Trial(f"nuscenes, {place}: {broken.name}", made_so, read, refused=True)


def _damaged(data: bytes, rng: np.random.Generator) -> Broken:
    """Return a file damaged in one of several ways."""
    ways = [
        *cuts(data, rng, 1),
        *flips(data, rng, 2),
        *random_bytes(rng),
        Broken("0 is nan", data.replace(b"0", b"nan", 2)),
        Broken("1 is 1e308", data.replace(b"1", b"1e308", 3)),
        Broken("doubled", data + data),
    ]
    return ways[int(rng.integers(len(ways)))]


def _copied(whole: Path, drive: Path, place: str | None, broken: Broken | None, root: Path) -> Path:
    """Make a copy in which one file is another, or gone; return its drive."""
    shutil.copytree(whole, root, dirs_exist_ok=True)
    if place is not None and broken is None:
        (root / place).unlink()
    elif place is not None and broken is not None:
        (root / place).write_bytes(broken.data)
    return root / drive


def _file(name: str, data: bytes, root: Path) -> Path:
    (root / name).write_bytes(data)
    return root / name


def _refused(act: Callable[[Path], object]) -> Callable[[Path], int]:
    """Return an act that reports errors as the command line does."""

    def said(path: Path) -> int:
        try:
            act(path)
        except UserError as error:
            print(printable(f"p2gs-jax: error: {error}"), file=sys.stderr)
            return REFUSED
        return 0

    return said


def _exposures() -> Iterator[Trial]:
    rng = np.random.default_rng(SEED + 10)
    table = "image,ev\n" + "".join(f"{name},{k / 2}\n" for k, name in enumerate(scenes.names()))
    act = _refused(lambda path: check_source(str(path)))
    for broken in (
        *wrong_words(table, rng, 12),
        *cuts(table.encode(), rng, 8),
        *flips(table.encode(), rng, 20),
        *random_bytes(rng),
        Broken("a quote that never ends", table.replace("0.5", '"0.5').encode()),
        Broken("a field of a megabyte", f"image,ev\n{'x' * 2**20},1\n".encode()),
        Broken("no columns", b"\n\n\n"),
        Broken("a column twice", b"image,ev,ev\na,1,2\n"),
        Broken("more values than columns", b"image,ev\na,1,2,3\n"),
        Broken("UTF-16", table.encode("utf-16")),
    ):
        yield Trial(f"exposures: {broken.name}", partial(_file, "exposures.csv", broken.data), act)


def _cameras() -> Iterator[Trial]:
    rng = np.random.default_rng(SEED + 11)
    camera = {
        "name": "a",
        "viewmat": np.eye(4).tolist(),
        "K": [[50, 0, 24], [0, 50, 16], [0, 0, 1]],
        "width": 48,
        "height": 32,
        "exposure_ev": 0.5,
        "gamma": 2.2,
        "time": 0.0,
    }
    path = {
        "render_width": 48,
        "render_height": 32,
        "camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0}],
    }
    act = _refused(read_cameras)
    for name, tree in (("cameras", [camera]), ("camera path", path)):
        for broken in wrong_json(tree, rng, 0.15):
            yield Trial(f"{name}: {broken.name}", partial(_file, "cameras.json", broken.data), act)


def _runs(made: Path) -> Iterator[Trial]:
    """Yield trials of a run's files; it is fitted first."""
    scene, whole = made / "scene", made / "run"
    scenes.write_colmap(scene)
    ended = in_child(lambda: fit_into(scene, whole), scene, 300, ADDRESSES)
    if ended.code != 0:
        raise RuntimeError(f"no run could be made: {ended.text[-500:]}")
    rng = np.random.default_rng(SEED + 12)
    act = _refused(load_run)
    for place in RUN_FILES:
        data = (whole / place).read_bytes()
        found = [*cuts(data, rng, 2), *flips(data, rng, 3), *list(random_bytes(rng))[::4]]
        if place.endswith(".json"):
            every = list(wrong_json(json.loads(data), rng, 0.3))
            found += [every[int(k)] for k in rng.choice(len(every), 6, replace=False)]
        for broken in found:
            make = partial(_run_with, whole, place, broken)
            yield Trial(f"run, {place}: {broken.name}", make, act, data=ADDRESSES)


def _run_with(whole: Path, place: str, broken: Broken, root: Path) -> None:
    for name in RUN_FILES:
        shutil.copyfile(whole / name, root / name)
    (root / place).write_bytes(broken.data)
