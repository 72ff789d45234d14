"""Small inputs after reports by users of neighbouring programs, each with the right result.

T1, S10 and the like are the numbers of faults in experiments/results/2026-11-26-mended.md.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from reliability import scenes
from reliability.family import Family, Report
from reliability.trials import NONSENSE, REFUSED, Trial, run_trials

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene import find_scene, with_masks_and_split
from p2gs_jax.scene.exposures import read_known_exposures
from p2gs_jax.scene.masks import with_alpha
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene

NAME = "neighbours"
ABOUT = """These are scenes of users of 3DGS, gsplat, nerfstudio, COLMAP and devkits: folders of
several cameras, models and masks in other places and under other names, poses far from the origin,
byte-order marks, constant alpha, colours of other types. Each is read with the right values, or
refused by name."""
SPACING = 4
NAMES = scenes.names()
Check = Callable[[Scene], bool]


@dataclass(frozen=True)
class Case:
    """A scene, and the right result."""

    make: Callable[[Path], object]  # writes the scene into an empty folder
    right: Check | None = None  # whether the scene was read well; None: it is refused
    says: tuple[str, ...] = ()  # words of the refusal
    known: bool = False  # an exposure is known by the name of a file alone


def run(quick: bool, out: Path, report: Report) -> Family:
    """Run the trials; `quick`: every fourth one."""
    return run_trials(NAME, list(trials())[:: SPACING if quick else 1], out, report)


def trials() -> Iterator[Trial]:
    """Yield the trials, in their order."""
    for name, case in CASES.items():

        def make(root: Path, case: Case = case) -> None:
            case.make(root)
            if case.known:
                (root / "known.csv").write_text("image,exposure\na.png,1\n")

        yield Trial(name, make, partial(_tried, case), case.says, case.right is None)
    for words, seconds in BUDGETS.items():
        act = partial(_budget, words, seconds)
        yield Trial(f"--budget {words}", lambda root: root, act, (words,), seconds is None)


def _tried(case: Case, root: Path) -> int:
    """Read a scene as a fit does, but for structure from motion."""
    cfg = DataConfig()
    try:
        scene = find_scene(root, cfg)
        if isinstance(scene, Scene):
            scene = with_alpha(with_masks_and_split(scene, cfg), cfg)
            store = ImageStore(scene.views, cfg)
            store.get(0)
            store.close()
            if case.known:
                read_known_exposures(str(root / "known.csv"), list(scene.views))
        if case.right is None or case.right(scene):  # pyright: ignore[reportArgumentType]
            return 0
    except UserError as error:
        print(printable(f"p2gs-jax: error: {error}"), file=sys.stderr)
        return REFUSED
    print(f"not what is right: {scene}"[:300], file=sys.stderr)
    return NONSENSE


def _budget(words: str, seconds: float | None, root: Path) -> int:
    from p2gs_jax.cli.shared import parse_duration

    try:
        return 0 if parse_duration(words) == seconds else NONSENSE
    except UserError as error:
        print(error, file=sys.stderr)
        return REFUSED


BUDGETS = {"90s": 90.0, "1h30": 5400.0, "2h15": 8100.0, "1h30m": 5400.0, "1.5h": 5400.0, "1x": None}


# ------------------------------------------------------------------------------- writers


def colmap(
    root: Path, rename: Callable[[str, int], str] = lambda name, k: name, cameras: bool = False
) -> dict[str, str]:
    """Write the text model with renamed photographs; `cameras`: of two cameras alternately."""
    scenes.write_colmap(root, text=True)
    text = scenes.colmap_text()
    for k, name in enumerate(NAMES):
        text["images.txt"] = text["images.txt"].replace(name, rename(name, k))
        if cameras:
            text["images.txt"] = text["images.txt"].replace(
                f" 1 {rename(name, k)}", f" {k % 2 + 1} {rename(name, k)}"
            )
        _moved(root / "images" / name, root / "images" / rename(name, k))
    if cameras:
        row = text["cameras.txt"].splitlines()[-1].split()
        rows = [" ".join([str(k + 1), *row[1:4], str(40 + 9 * k), *row[5:]]) for k in range(2)]
        text["cameras.txt"] = "\n".join(rows) + "\n"
    for name, content in text.items():
        (root / "sparse" / "0" / name).write_text(content)
    return text


def _moved(source: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    source.rename(place)


def model_at(*places: str) -> Callable[[Path], None]:
    """Return a writer of the model at the last place, and of a single view at the others."""

    def make(root: Path) -> None:
        model = scenes.write_colmap(root, text=True)
        files = scenes.colmap_text()
        _moved(model, root / "kept")
        (root / "sparse").rmdir()
        for place in places:
            (root / place).mkdir(parents=True)
            for name, content in files.items():
                few = content.splitlines()[:2] if name == "images.txt" else content.splitlines()
                rows = content.splitlines() if place == places[-1] else few
                (root / place / name).write_text("\n".join(rows) + "\n")

    return make


def transforms(change: Callable[[dict], object], root: Path) -> None:
    """Write a changed transforms.json."""
    scenes.write_transforms(root)
    data = scenes.transforms()
    change(data)
    (root / "transforms.json").write_text(json.dumps(data))


def per_frame(data: dict) -> None:
    """Give every other frame the intrinsics of another camera."""
    for k, frame in enumerate(data["frames"]):
        frame |= {"fl_x": 40.0 + 9 * (k % 2), "fl_y": 40.0 + 9 * (k % 2)}


def far(*offset: float) -> Callable[[Path], None]:
    """Return a writer of a COLMAP model whose world is moved."""

    def make(root: Path) -> None:
        text = colmap(root)
        at = np.array(offset)
        lines = text["images.txt"].splitlines()
        for k in range(0, len(lines), 2):
            words = lines[k].split()
            words[5:8] = [f"{float(w) - o:.9f}" for w, o in zip(words[5:8], at, strict=True)]
            lines[k] = " ".join(words)
        points = [line.split() for line in text["points3D.txt"].splitlines()]
        for words in points:
            words[1:4] = [f"{float(w) + o:.9f}" for w, o in zip(words[1:4], at, strict=True)]
        (root / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
        (root / "sparse/0/points3D.txt").write_text("\n".join(map(" ".join, points)) + "\n")

    return make


def masked(place: str, suffix: str = "", alpha: bool = False, images: bool = False) -> Callable:
    """Return a writer of masks under other names, their left halves hidden."""

    def make(root: Path) -> None:
        if images:
            scenes.write_photographs(root / "images")
        else:
            scenes.write_colmap(root)
        mask = np.full((scenes.HEIGHT, scenes.WIDTH), 255, np.uint8)
        mask[:, : scenes.WIDTH // 2] = 0
        for name in NAMES:
            pixels = np.dstack([np.full_like(mask, 255)] * 3 + [mask]) if alpha else mask
            path = root / place / (suffix.format(Path(name).stem) or name)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), pixels)

    return make


def with_alpha_of(value: int, root: Path) -> None:
    """Write photographs whose alpha is one value everywhere."""
    scenes.write_colmap(root)
    for name in NAMES:
        path = root / "images" / name
        pixels = np.asarray(Image.open(path).convert("RGBA")).copy()
        pixels[..., 3] = value
        Image.fromarray(pixels).save(path, "PNG")


def seeds(kind: str, most: float, root: Path) -> None:
    """Write seed points whose colours have this type and reach to `most`."""
    scenes.write_transforms(root)
    head, rows = scenes.ply().split("end_header\n")
    for color in ("red", "green", "blue"):
        head = head.replace(f"property uchar {color}", f"property {kind} {color}")
    lines = [line.split() for line in rows.splitlines()]
    digits = 4 if kind == "float" else 0
    scaled = [[*w[:3], *(f"{float(c) * most / 255:.{digits}f}" for c in w[3:])] for w in lines]
    rows = "\n".join(map(" ".join, scaled)) + "\n"
    (root / "points.ply").write_text(head + "end_header\n" + rows)


def exif(tags: dict[int, Any], root: Path) -> None:
    """Write JPEGs that carry these tags, exposure times a stop apart."""
    colmap(root, lambda name, k: name.replace(".png", ".jpg"))
    for k, path in enumerate(sorted((root / "images").iterdir())):
        image = Image.open(path).convert("RGB")
        found = image.getexif()
        found.get_ifd(0x8769).update({t: v(k) if callable(v) else v for t, v in tags.items()})
        image.save(path, "JPEG", exif=found)


def with_mark(*places: str) -> Callable[[Path], None]:
    """Return a writer of both kinds of scene whose text begins with a byte-order mark."""

    def make(root: Path) -> None:
        if places[0].startswith("transforms"):
            scenes.write_transforms(root)
        else:
            scenes.write_colmap(root, text=True)
        for place in places:
            path = root / place
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())

    return make


def without_points(root: Path) -> None:
    """Write a model without points, and its points as a PLY file beside it."""
    model = scenes.write_colmap(root, text=True)
    (model / "points3D.txt").unlink()
    (model / "points3D.ply").write_text(scenes.ply())


def linked(root: Path) -> None:
    """Write a transforms.json with absolute paths through a link."""
    scenes.write_transforms(root)
    os.symlink(root, root.parent / "here")
    data = scenes.transforms()
    for frame in data["frames"]:
        frame["file_path"] = str(root.parent / "here" / frame["file_path"])
    del data["train_filenames"], data["test_filenames"]
    (root / "transforms.json").write_text(json.dumps(data))


# ---------------------------------------------------------------------- right results


def cameras(count: int) -> Check:
    """Return a check that the views have so many physical cameras."""
    return lambda scene: len({view.camera for view in scene.views}) == count


def whole(scene: Scene) -> bool:
    """Return whether all views and points were read."""
    return (len(scene.views), len(scene.points)) == (len(NAMES), scenes.POINTS)


def sharp(scene: Scene) -> bool:
    """Return whether points are within 0.1 pixels of where the photographs show them."""
    t = scene.tracks
    assert t is not None
    return all(
        np.abs(
            project_points(scene.points[t.point_indices[t.view_indices == k]], view)[0]
            - t.xy[t.view_indices == k]
        ).max()
        < 0.1
        for k, view in enumerate(scene.views)
    )


def half_hidden(scene: Scene) -> bool:
    """Return whether half of every view is masked."""
    store = ImageStore(scene.views, DataConfig())
    shown = [store.get(k)[1].mean() for k in range(len(scene.views))]
    store.close()
    return bool(np.allclose(shown, 0.5, atol=0.05))


def photographs(count: int) -> Callable[[Any], bool]:
    """Return a check that so many photographs were found, and nothing else."""
    return lambda found: len(found.paths) == count


def no_alpha(scene: Scene) -> bool:
    """Return whether the photographs are opaque, without a backdrop."""
    return ImageStore(scene.views, DataConfig()).backdrop is None


def same_colors(scene: Scene) -> bool:
    """Return whether the seeds have their 8-bit colours, with an error of at most 1."""
    expected = [line.split()[3:] for line in scenes.ply().split("end_header\n")[1].splitlines()]
    assert scene.point_colors is not None
    return bool(
        np.abs(np.asarray(scene.point_colors, float) - np.array(expected, float)).max() <= 1
    )


def a_stop_apart(scene: Scene) -> bool:
    """Return whether each view is a stop brighter than the one before, by EXIF."""
    found = [view.exif_ev for view in scene.views]
    return None not in found and bool(np.allclose(np.diff(np.array(found, float)), 1, atol=0.02))


def noted(words: str) -> Check:
    """Return a check that a note has these words."""
    return lambda scene: any(words in note for note in scene.notes)


SECONDS = {0x829A: lambda k: 2.0**k / 500}
CASES: dict[str, Case] = {
    "T1 rig1/cameraN": Case(
        lambda r: colmap(r, lambda n, k: f"rig1/camera{k % 2}/{n}", cameras=True), cameras(2)
    ),
    "T1 rig1/cameraN of one kind": Case(
        lambda r: colmap(r, lambda n, k: f"rig1/camera{k % 2}/{n}"), cameras(2)
    ),
    "T1 two of COLMAP in a folder": Case(lambda r: colmap(r, cameras=True), cameras(2)),
    "T1 two intrinsics in a folder": Case(partial(transforms, per_frame), cameras(2)),
    "T2 UTM": Case(far(4.5e5, 5.2e6, 100.0), sharp),
    "T2 the other hemisphere": Case(far(-6.3e6, 1.2e6, -3e6), sharp),
    "T4 masks/NAME_mask.png": Case(masked("masks", "{}_mask.png"), half_hidden),
    "T4 masks/NAME.mask.png": Case(masked("masks", "{}.mask.png"), half_hidden),
    "T4 masks/NAME.png.png": Case(masked("masks", "{}.png.png"), half_hidden),
    "T4 masks/NAME.PNG": Case(masked("masks", "{}.PNG"), half_hidden),
    "T4 masks/NAME.jpg": Case(masked("masks", "{}.jpg"), half_hidden),
    "T4 mask/": Case(masked("mask"), half_hidden),
    "T4 alpha is the mask": Case(masked("masks", alpha=True), half_hidden),
    "T4 of no photograph": Case(masked("masks", "other{}.png"), noted("none has the name of a")),
    "T5 images/masks/": Case(masked("images/masks", images=True), photographs(4)),
    "T5 images/NAME_mask.png": Case(masked("images", "{}_mask.png", images=True), photographs(4)),
    "T6 opaque alpha": Case(partial(with_alpha_of, 255), no_alpha),
    "T7 alpha of nothing": Case(partial(with_alpha_of, 0), says=("images",)),
    **{
        f"T8 {place}": Case(model_at(place), whole)
        for place in ("colmap/sparse/0", "dense/0/sparse", "distorted/sparse/0", "sparse/model")
    },
    "T8 sparse/1 alone": Case(model_at("sparse/1"), whole),
    "T9 the larger is 1": Case(model_at("sparse/0", "sparse/1"), whole),
    "T10 another case": Case(
        lambda r: (colmap(r), [p.rename(p.with_suffix(".PNG")) for p in (r / "images").iterdir()]),
        whole,
    ),
    "T12 ushort colours": Case(partial(seeds, "ushort", 65535.0), same_colors),
    "T12 float colours": Case(partial(seeds, "float", 1.0), same_colors),
    "T13 time alone": Case(partial(exif, SECONDS), a_stop_apart),
    "T13 no f-number": Case(partial(exif, SECONDS | {0x8827: 200}), a_stop_apart),
    "T13 APEX": Case(
        partial(exif, {0x9201: lambda k: math.log2(500) - k, 0x9202: 3.0}), a_stop_apart
    ),
    "T14 COLMAP": Case(with_mark(*(f"sparse/0/{n}" for n in scenes.colmap_text())), whole),
    "T14 transforms": Case(with_mark("transforms.json"), whole),
    "T15 names of several": Case(
        lambda r: colmap(r, lambda n, k: f"cam{k}/a.png"), says=("a.png",), known=True
    ),
    "T17 points as PLY": Case(without_points, whole),
    "T18 degrees": Case(
        partial(
            transforms, lambda d: (d.update(camera_angle_x=50.0), d.pop("fl_x"), d.pop("fl_y"))
        ),
        says=("transforms.json",),
    ),
    "S10 through a link": Case(linked, whole),
    "S14 blanks": Case(lambda r: colmap(r, lambda n, k: f"IMG ({k}).png"), whole),
}
