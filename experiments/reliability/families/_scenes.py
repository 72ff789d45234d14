"""Scenes of dots that are fitted in seconds, each of their numbers as hard as wanted.

Dots at random in front of a row of cameras, seen under exposures of their own, written as a COLMAP
text model with tracks: `Made` says what is seen, a family what is changed about it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

GAMMA = 2.2
FOCAL = 60.0
# Options of fits that are small: one level, few Gaussians, no seeds but the points.
SMALL_FIT = {
    "train.coarse_to_fine": [],
    "densify.max_gaussians": 300,
    "densify.min_every_steps": 10,
    "render.sh_degree": 0,
    "init.shell": "off",
    "init.dense": "off",
}


def in_a_row(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rotations and centres of cameras side by side, looking along z."""
    return [(np.eye(3), np.array([k / max(count - 1, 1) - 0.5, 0.0, 0.0])) for k in range(count)]


@dataclass(frozen=True)
class Made:
    """A scene to be written.

    Attributes:
        views: how many.
        points: dots.
        sizes: width and height of the images; views take them in turn.
        exposures: log2 of each view's, or None: half a stop apart at random.
        light: factor on all radiance.
        cameras: from a count to rotations (world to camera) and centres.
        scale: scene units a unit.
        origin: of the scene, scene units.
        develop: from (row, codes in [0, 1]) to the codes that are written.
        mask: from (row, height, width) to the mask, or None: none is written.
        tracks: False writes points that no photograph is said to show.
    """

    views: int = 6
    points: int = 80
    sizes: tuple[tuple[int, int], ...] = ((64, 48),)
    exposures: tuple[float, ...] | None = None
    light: float = 1.0
    cameras: Callable[[int], list[tuple[np.ndarray, np.ndarray]]] = in_a_row
    scale: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    develop: Callable[[int, np.ndarray], np.ndarray] | None = None
    mask: Callable[[int, int, int], np.ndarray] | None = None
    tracks: bool = True


def write_scene(root: Path, made: Made, seed: int = 0) -> Path:
    """Write a scene and return its folder."""
    rng = np.random.default_rng(seed)
    local = rng.uniform([-1.2, -0.8, 3], [1.2, 0.8, 6], (made.points, 3))
    color = rng.uniform(0.05, 0.9, (made.points, 3))
    stops = rng.normal(0, 0.5, made.views) if made.exposures is None else made.exposures
    world = local * made.scale + np.array(made.origin)
    model = root / "sparse" / "0"
    for folder in (model, root / "images"):
        folder.mkdir(parents=True)
    tracks: dict[int, list[tuple[int, int]]] = {p: [] for p in range(made.points)}
    lines, cameras = [], []
    for v, (rotation, center) in enumerate(made.cameras(made.views)):
        width, height = made.sizes[v % len(made.sizes)]
        seen = (local - center) @ rotation.T
        image, found = _photograph(seen, color, 2.0 ** stops[v] * made.light, width, height)
        if made.develop is not None:
            image = made.develop(v, image)
        name = f"{v}.png"
        cv2.imwrite(str(root / "images" / name), np.rint(image * 255).astype(np.uint8)[..., ::-1])
        if made.mask is not None:
            (root / "masks").mkdir(exist_ok=True)
            cv2.imwrite(str(root / "masks" / f"{name}.png"), made.mask(v, height, width))
        shown = []
        for p, x, y in found:
            tracks[p].append((v + 1, len(shown)))
            shown.append(f"{x:.4f} {y:.4f} {p + 1}")
        t = -rotation @ (center * made.scale + np.array(made.origin))
        q = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        pose = " ".join(repr(float(x)) for x in (*q, *t))
        observed = " ".join(shown) if made.tracks else ""
        lines += [f"{v + 1} {pose} {v + 1} {name}", observed]
        f = FOCAL * width / 64
        cameras.append(f"{v + 1} PINHOLE {width} {height} {f} {f} {width / 2} {height / 2}")
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "cameras.txt").write_text("\n".join(cameras) + "\n")
    rows = []
    for p, track in tracks.items():
        rgb = " ".join(str(int(255 * c ** (1 / GAMMA))) for c in color[p])
        pairs = " ".join(f"{i} {k}" for i, k in track) if made.tracks else ""
        place = " ".join(repr(float(x)) for x in world[p])
        rows.append(f"{p + 1} {place} {rgb} 0.5 {pairs}")
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return root


def _photograph(
    seen: np.ndarray, color: np.ndarray, light: float, width: int, height: int
) -> tuple[np.ndarray, list[tuple[int, float, float]]]:
    """Return codes in [0, 1], and row and place of every dot in the picture."""
    image = np.full((height, width, 3), min(0.2 * light, 1e3))
    found = []
    focal = FOCAL * width / 64
    for p in np.argsort(-seen[:, 2]):
        if seen[p, 2] < 0.1:
            continue
        x, y = seen[p, :2] / seen[p, 2] * focal + [width / 2, height / 2]
        if 2 < x < width - 2 and 2 < y < height - 2:
            middle = (round(x * 16 - 8), round(y * 16 - 8))
            dot = np.minimum(light * color[p], 1e3).tolist()
            cv2.circle(image, middle, 2 * 16, dot, -1, cv2.LINE_AA, 4)
            found.append((int(p), x, y))
    return np.clip(image, 0, 1) ** (1 / GAMMA), found
