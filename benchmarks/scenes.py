"""Scenes: streets of splats, and the populations and cameras of a fit's levels.

The scenes need neither a fit nor a file. A town's surfaces are sampled where the drive's cameras
see them, and become Gaussians like the seeds of a fit. Opacities, sizes, shapes and colours are
then moved, partly or wholly, to the statistics measured on a finished fit. The room has layers of
splats of low opacity, like fits of indoor captures.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.gaussians.seeds import gaussians_from_points
from p2gs_jax.render.harmonics import C0
from p2gs_jax.synth.furnish import build_town
from p2gs_jax.synth.rig import MOUNTS, camera_viewmat, drive, intrinsics
from p2gs_jax.synth.settings import image_height
from p2gs_jax.synth.town import Town
from p2gs_jax.types import Camera, Gaussians, View


class BenchScene(NamedTuple):
    """Gaussians and a camera, with their name in tables."""

    name: str
    gaussians: Gaussians
    camera: Camera


def street(
    count: int,
    width: int,
    height: int,
    *,
    radius: float = 3.0,
    spread: float = 1.05,
    degree: int = 0,
) -> BenchScene:
    """Return a canyon of ground, walls and backdrop: most splats near its surface, some behind.

    `radius` is the median radius at the alpha cutoff of 1/255, pixels; `spread` is the standard
    deviation of its logarithm.
    """
    rng = np.random.default_rng(0)
    focal = 0.75 * width
    u = rng.uniform(-0.05 * width, 1.05 * width, count)
    v = rng.uniform(-0.05 * height, 1.05 * height, count)
    dx, dy = (u - width / 2) / focal, (v - height / 2) / focal
    ground = np.where(dy > 0.02, 1.6 / np.maximum(dy, 0.02), 80.0)
    surface = np.minimum(np.minimum(ground, 7 / np.maximum(np.abs(dx), 0.08)), 90.0)
    layer = rng.choice(3, count, p=[0.72, 0.2, 0.08])
    factor = [np.exp(rng.normal(0, 0.02, count)), rng.uniform(1, 1.8, count)]
    factor.append(rng.uniform(0.3, 1, count))
    z = np.clip(surface * np.choose(layer, factor), 1.0, 150.0)
    logits = rng.normal(0, 2, count)
    reach = np.sqrt(np.maximum(2 * np.log(255 / (1 + np.exp(-logits))), 0.5))
    sigma = radius * np.exp(rng.normal(0, spread, count)) / reach * z / focal
    shape = rng.normal(0, 0.5, (count, 3))
    shape -= shape.mean(1, keepdims=True)
    shape[np.arange(count), rng.integers(0, 3, count)] -= 1.0
    log_scales = np.log(sigma)[:, None] + shape + 0.25
    log_radiance = rng.normal(-1, 1, (count, 3))
    means = np.stack([dx * z, dy * z, z], -1)
    quats = rng.normal(size=(count, 4))
    sh = rng.normal(0, 0.1, (count, (degree + 1) ** 2, 3))
    # exp(C0 sh0) is the radiance without the higher degrees.
    sh[:, 0] = log_radiance / C0
    leaves = (means, quats, log_scales, logits, sh)
    gaussians = Gaussians(*(jnp.asarray(a, jnp.float32) for a in leaves))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    camera = Camera(jnp.eye(4), jnp.asarray(K), width, height)
    return BenchScene(f"street {count // 1000}k", gaussians, camera)


FRAMES, SEEN_PER_CAMERA = 30, 6
FARTHEST = 90.0  # largest distance of points, m, as for the seed points of `synth`
GROUND_ALBEDO, AMBIENT = 0.12, 0.35
# Progress of a fit at each level of coarse-to-fine: 0 are the seeds, 1 is the end.
PROGRESS = {4: 0.25, 2: 0.6, 1: 1.0}

# The next statistics were measured after 700 steps on 90 photographs of 480x325 pixels of a town,
# from 59,908 seeds (`synth --seed 3`). The quantiles 5, 25, 50, 75 and 95 % of the opacity of the
# 75,000 Gaussians were 0.007, 0.02, 0.12, 0.31 and 0.78.
# Number of Gaussians relative to seeds:
GROWN = 1.25
# Mean and standard deviation of the opacity logit, and of the log of the largest scale relative to
# the distance of the neighbours:
LOGIT, LARGE = (-2.1, 1.9), (0.05, 0.6)
# Share of the Gaussians that relocation has shrunk, and the change of their log scale:
SHRUNK = (0.25, -0.8)
# Mean log ratios of largest to middle and of middle to smallest scale:
GAPS = (0.6, 0.55)
# Median size of the coefficients above degree 0, and its spread (log):
SH = (0.023, 0.9)


def town_level(shrink: int, *, width: int = 480, points: int = 60_000) -> BenchScene:
    """Return a town with the population and camera of one level of coarse-to-fine.

    Args:
        shrink: factor by which the level shrinks photographs: 4, 2 or 1.
        width: width of the photographs, pixels.
        points: number of seeds.
    """
    views = _drive_views(width)
    xyz, radiance = _surface_points(width, points)
    gaussians = _along_a_fit(xyz, radiance, views, PROGRESS[shrink])
    view = next(v for v in views if v.name == "front/000001.png")
    size = max(round(view.width / shrink), 1), max(round(view.height / shrink), 1)
    K = np.diag([size[0] / view.width, size[1] / view.height, 1.0]) @ view.K
    camera = Camera(jnp.asarray(view.viewmat), jnp.asarray(K, jnp.float32), *size)
    return BenchScene(f"town 1/{shrink}", gaussians, camera)


def _along_a_fit(
    xyz: np.ndarray, radiance: np.ndarray, views: list[View], progress: float
) -> Gaussians:
    """Return Gaussians like those of a fit at this progress, from 0 (the seeds) to 1 (the end)."""
    rng = np.random.default_rng([3, 1])
    start = gaussians_from_points(xyz, radiance, views, FitConfig())
    clones = rng.choice(len(xyz), round(progress * (GROWN - 1) * len(xyz)))
    leaves = {
        f.name: np.asarray(getattr(start, f.name), np.float64)[np.r_[: len(xyz), clones]]
        for f in dataclasses.fields(start)
        if getattr(start, f.name) is not None
    }
    count, near = len(xyz) + len(clones), leaves["log_scales"][:, 0].copy()
    logit = rng.normal(*LOGIT, count)
    large = rng.normal(*LARGE, count)
    shrunk = rng.random(count) < SHRUNK[0]
    large[shrunk] += SHRUNK[1] + rng.normal(0, 1, int(shrunk.sum()))
    gaps = [rng.exponential(mean, count) for mean in GAPS]
    axes = large - np.stack([np.zeros(count), gaps[0], gaps[0] + gaps[1]])
    leaves["log_scales"] = near[:, None] + progress * rng.permuted(axes.T, axis=1)
    leaves["opacity_logits"] += progress * (logit - leaves["opacity_logits"])
    leaves["quats"] = leaves["quats"] + progress * rng.normal(size=(count, 4))
    # Means leave the surface by a share of the distance of the neighbours.
    leaves["means"] += progress * 0.5 * np.exp(near)[:, None] * rng.normal(size=(count, 3))
    size = SH[0] * np.exp(rng.normal(0, SH[1], (count, 1, 1)))
    leaves["sh"][:, 1:] = progress * size * rng.normal(size=leaves["sh"][:, 1:].shape)
    arrays = {k: jnp.asarray(v, jnp.float32) for k, v in leaves.items()}
    return Gaussians(**arrays)  # pyright: ignore[reportArgumentType]


def _view(name: str, viewmat: np.ndarray, K: np.ndarray, width: int, height: int) -> View:
    viewmat, K = viewmat.astype(np.float32), K.astype(np.float32)
    return View(name, Path("nowhere") / name, name.partition("/")[0], viewmat, K, width, height)


def _drive_views(width: int) -> list[View]:
    height = image_height(width)
    K, track = intrinsics(width, height), drive(FRAMES)
    return [
        _view(f"{camera}/{f:06d}.png", camera_viewmat(mount, track[f]), K, width, height)
        for camera, mount in MOUNTS.items()
        for f in range(FRAMES)
    ]


@functools.lru_cache(maxsize=2)
def _surface_points(width: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface points at random pixels of the drive's views, and their radiance."""
    town, rng = build_town(3, "town"), np.random.default_rng([3, 0])
    views = _drive_views(width)[:: FRAMES // SEEN_PER_CAMERA]
    each = -(-points // len(views))
    xyz, radiance = [], []
    for view in views:
        R, t = view.viewmat[:3, :3].astype(np.float64), view.viewmat[:3, 3].astype(np.float64)
        # Rays to the sky are dropped; twice as many rays as points leave enough.
        pixels = rng.uniform((0, 0), (view.width, view.height), (2 * each, 2))
        rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(view.K.astype(np.float64)).T
        origin, direction = -R.T @ t, rays @ R
        distance, row, normal = _first_hits(town, origin, direction, _in_view(town, view))
        hit = np.flatnonzero(distance < FARTHEST)[:each]
        xyz.append(origin + distance[hit, None] * direction[hit])
        albedo = np.concatenate([town.color, np.full((1, 3), GROUND_ALBEDO)])[row[hit]]
        sun = np.asarray(town.light.sun_direction)
        lit = np.maximum(normal[hit] @ (sun / np.linalg.norm(sun)), 0)[:, None]
        light = AMBIENT + lit * np.asarray(town.light.sun)
        texture = np.exp(rng.normal(0, 0.4, (len(hit), 1)) + rng.normal(0, 0.05, (len(hit), 3)))
        radiance.append(albedo * light * texture)
    return np.concatenate(xyz)[:points], np.concatenate(radiance)[:points]


def _in_view(town: Town, view: View) -> np.ndarray:
    """Return the rows of the primitives that are not wholly outside of a view."""
    corner = np.indices((2, 2, 2)).reshape(3, 8).T[:, None]
    corners = np.where(corner, town.hi, town.lo) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    x, _, z = np.moveaxis(corners, -1, 0)
    wide = view.width / (2 * view.K[0, 0])
    outside = (z < 0).all(0) | (x > wide * z).all(0) | (x < -wide * z).all(0)
    return np.flatnonzero(~outside)


def _first_hits(town: Town, origin: np.ndarray, direction: np.ndarray, among: np.ndarray):
    """Return distances along rays (inf: sky), rows of the primitives hit, and normals.

    Only the primitives `among` count. Each is replaced by its bounding box, because only number and
    size in the view matter.
    """
    safe = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    with np.errstate(divide="ignore"):
        best = np.where(safe[:, 2] < 0, -origin[2] / safe[:, 2], np.inf)
    row = np.full(len(direction), town.size)
    normal = np.tile([0.0, 0.0, 1.0], (len(direction), 1))
    for i in among.tolist():
        a, b = (town.lo[i] - origin) / safe, (town.hi[i] - origin) / safe
        entries = np.minimum(a, b)
        entry, leave = entries.max(1), np.maximum(a, b).min(1)
        hit = (entry <= leave) & (entry > 1e-4) & (entry < best)
        best[hit], row[hit] = entry[hit], i
        axis = entries[hit].argmax(1)
        normal[hit] = -np.sign(safe[hit, axis])[:, None] * np.eye(3)[axis]
    return best, row, normal


# Corners of the room and of its furniture, m.
ROOM = ((-3.0, -2.0, 0.0), (3.0, 2.0, 2.6))
FURNITURE = (
    ((-0.6, -0.5, 0.0), (0.9, 0.5, 0.75)),  # table
    ((1.3, -1.9, 0.0), (2.9, -1.0, 0.85)),  # sofa
    ((1.3, -1.9, 0.85), (2.9, -1.65, 1.2)),  # its back
    ((2.4, 0.3, 0.0), (2.95, 1.9, 2.1)),  # shelf
    ((-0.4, 1.3, 0.0), (0.6, 1.95, 1.4)),  # cupboard
    ((0.9, -0.2, 0.75), (1.1, 0.0, 1.2)),  # lamp
)
LAYERS, LAYER_M = 4, 0.06
DETAIL = 2.5  # density of Gaussians on furniture relative to walls


def room(*, width: int = 500, points: int = 24_000) -> BenchScene:
    """Return a closed room from inside, with long tile lists of splats of low opacity.

    The image has `width` x 0.75 `width` pixels; the room has `points` Gaussians.
    """
    rng = np.random.default_rng([0, 2])
    boxes = np.array([ROOM, *FURNITURE])
    size = boxes[:, 1] - boxes[:, 0]
    areas = size[:, [1, 0, 0]] * size[:, [2, 2, 1]]  # of the faces across x, y, z
    areas[1:] *= DETAIL
    weight = np.repeat(areas[:, :, None], 2, 2).reshape(-1)
    face = rng.choice(len(weight), points, p=weight / weight.sum())
    box, axis, side = face // 6, face // 2 % 3, face % 2
    xyz = boxes[box, 0] + rng.random((points, 3)) * size[box]
    rows = np.arange(points)
    xyz[rows, axis] = boxes[box, side, axis]
    # Layers lie behind the surface: outside of the room, inside of the furniture.
    outwards = np.where(box == 0, 1, -1) * np.where(side == 1, 1, -1)
    xyz[rows, axis] += outwards * LAYER_M * rng.integers(0, LAYERS, points)
    shade = np.exp(rng.normal(-1.5, 0.5, len(weight)))[face, None]
    radiance = shade * np.exp(rng.normal(0, 0.4, (points, 3)))

    view = _room_view(width)
    gaussians = gaussians_from_points(xyz, radiance, [view], FitConfig())
    spread = rng.normal(0, 1.0, points)[:, None] - np.abs(rng.normal(0, 0.8, (points, 3)))
    sh = np.array(gaussians.sh)
    sh[:, 1:] = rng.normal(0, 0.1, sh[:, 1:].shape)
    gaussians = dataclasses.replace(
        gaussians,
        quats=jnp.asarray(rng.normal(size=(points, 4)), jnp.float32),
        log_scales=gaussians.log_scales + jnp.asarray(spread - 0.1, jnp.float32),
        opacity_logits=jnp.asarray(rng.normal(-3.0, 1.2, points), jnp.float32),
        sh=jnp.asarray(sh),
    )
    camera = Camera(jnp.asarray(view.viewmat), jnp.asarray(view.K), view.width, view.height)
    return BenchScene("room", gaussians, camera)


def _room_view(width: int) -> View:
    """Return the view from a corner to the opposite corner."""
    height, focal = round(0.75 * width), 0.8 * width
    center, target = np.array([-2.7, 1.7, 1.5]), np.array([1.5, -0.5, 0.9])
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return _view("room.png", viewmat, K, width, height)
