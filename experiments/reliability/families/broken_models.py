"""Camera models that are broken, in every format of a scene folder."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from reliability import scenes
from reliability.family import Family, Report
from reliability.mutations import (
    Broken,
    Field,
    cuts,
    flips,
    packed,
    random_bytes,
    truncations,
    wrong_json,
    wrong_lines,
    wrong_values,
    wrong_words,
)
from reliability.reading import read
from reliability.trials import Trial, run_trials

NAME = "broken_models"
ABOUT = """COLMAP models (binary and text), transforms.json, seed points, split lists and
masks that are cut at fields, flipped, miscounted or out of range. Each is read whole, or refused
with code 2 by a message that names file, fault and remedy, within 30 s and 2 GB."""
SEED = 20261123
SPACING = 9


def run(quick: bool, out: Path, report: Report) -> Family:
    """Try all; `quick`: every ninth."""
    return run_trials(NAME, list(trials())[:: SPACING if quick else 1], out, report)


def trials() -> Iterator[Trial]:
    """Yield all, in their order."""
    for text in (False, True):
        yield Trial(
            f"colmap whole ({text})",
            partial(_made, partial(scenes.write_colmap, text=text)),
            read,
            refused=False,
        )
    yield Trial("transforms whole", partial(_made, scenes.write_transforms), read, refused=False)
    yield from _colmap()
    yield from _transforms()
    yield from _masks()


def _made(write: Callable[[Path], object], root: Path) -> None:
    write(root)


def _with(write: Callable[[Path], object], place: str, broken: Broken) -> Trial:
    """Return a trial of a scene in which one file is another."""

    def make(root: Path) -> None:
        write(root)
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        (root / place).write_bytes(broken.data)

    return Trial(f"{place}: {broken.name}", make, read)


def _colmap() -> Iterator[Trial]:
    rng = np.random.default_rng(SEED)
    files: tuple[tuple[str, list[Field], float], ...] = (
        ("cameras", scenes.camera_fields(), 1.0),
        ("images", scenes.image_fields(), 0.05),
        ("points3D", scenes.point_fields(), 0.05),
    )
    for stem, fields, share in files:
        place, data = f"sparse/0/{stem}.bin", packed(fields)
        spared = list(truncations(fields))[:60]
        for broken in (
            *spared,
            *wrong_values(fields, rng, share),
            *flips(data, rng, 20),
            *random_bytes(rng),
            Broken("doubled", data + data),
        ):
            yield _with(scenes.write_colmap, place, broken)
    for name, text in scenes.colmap_text().items():
        for broken in (
            *wrong_words(text, rng, 14),
            *wrong_lines(text, rng, 4),
            *flips(text.encode(), rng, 6),
            *random_bytes(rng),
        ):
            yield _with(lambda root: scenes.write_colmap(root, True), f"sparse/0/{name}", broken)


def _transforms() -> Iterator[Trial]:
    rng = np.random.default_rng(SEED + 1)
    for broken in (
        *wrong_json(scenes.transforms(), rng, 0.25),
        *flips(json.dumps(scenes.transforms()).encode(), rng, 20),
    ):
        yield _with(scenes.write_transforms, "transforms.json", broken)
    text = scenes.ply()
    for broken in (
        *wrong_words(text, rng, 10),
        *wrong_lines(text, rng, 4),
        *random_bytes(rng),
        Broken(
            "a huge count", text.replace(f"vertex {scenes.POINTS}", "vertex 99999999999").encode()
        ),
        Broken(
            "a huge binary count",
            text.replace(f"vertex {scenes.POINTS}", "vertex 99999999999")
            .replace("ascii", "binary_little_endian")
            .encode(),
        ),
        Broken("a negative count", text.replace(f"vertex {scenes.POINTS}", "vertex -5").encode()),
    ):
        yield _with(scenes.write_transforms, "points.ply", broken)


def _masks() -> Iterator[Trial]:
    rng = np.random.default_rng(SEED + 3)
    height, width = scenes.HEIGHT, scenes.WIDTH
    white = np.full((height, width), 255, np.uint8)
    data = _png(white)
    sizes = {"1x1": (1, 1), "half": (height // 2, width // 2), "turned": (width, height)}
    for broken in (
        Broken("whole", data),
        Broken("hides everything", _png(np.zeros_like(white))),
        Broken("16 bits", _png(white.astype(np.uint16) * 257)),
        Broken("colour with alpha", _png(np.full((height, width, 4), 255, np.uint8))),
        *(Broken(name, _png(np.full(size, 255, np.uint8))) for name, size in sizes.items()),
        *cuts(data, rng, 8),
        *flips(data, rng, 12),
        *random_bytes(rng),
    ):
        yield _with(scenes.write_colmap, f"masks/{scenes.names()[1]}", broken)
    for broken in (*random_bytes(rng), Broken("of nothing", b"none.png\n")):
        yield _with(scenes.write_colmap, "sparse/0/test.txt", broken)


def _png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()
