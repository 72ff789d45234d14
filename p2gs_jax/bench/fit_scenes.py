"""Synthetic scenes with the populations and cameras of a fit's levels.

No fit is run and no file read. A town's surfaces are sampled where the drive's cameras see them and
become Gaussians as seeds do at the start of a fit; opacities, sizes, shapes and colours are then
changed to the statistics measured on a finished fit (`FITTED`), in part or wholly. The room has
layers of splats that hide little, as fits of indoor captures do.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.bench.scenes import BenchScene
from p2gs_jax.config import FitConfig
from p2gs_jax.gaussians.init.seeds import gaussians_from_points
from p2gs_jax.synth.build_town import build_town
from p2gs_jax.synth.rig import MOUNTS, camera_viewmat, drive, image_height, intrinsics
from p2gs_jax.synth.town import Town
from p2gs_jax.types import Camera, Gaussians, View

FRAMES, SEEN_PER_CAMERA = 30, 6
FARTHEST = 90.0  # m, as of the seed points of `synth`
GROUND_ALBEDO, AMBIENT = 0.12, 0.35
# State of a fit at each level of coarse-to-fine: 0 are the seeds, 1 is `FITTED`.
WAY = {4: 0.25, 2: 0.6, 1: 1.0}


@dataclasses.dataclass(frozen=True)
class Statistics:
    """Statistics of the Gaussians of a fit.

    Attributes:
        logit: mean and standard deviation of the opacity's logit.
        large: mean and standard deviation of the log of the largest standard deviation over the
            distance to the neighbours.
        shrunk: part of the Gaussians that relocation has made smaller, and by how much (log).
        gaps: mean ratios (log) of largest to middle and middle to smallest axis.
        sh: median size of the coefficients above degree 0, and its spread (log).
        grown: Gaussians over seeds.
    """

    logit: tuple[float, float]
    large: tuple[float, float]
    shrunk: tuple[float, float]
    gaps: tuple[float, float]
    sh: tuple[float, float]
    grown: float


# After 700 steps on 90 photographs of a town of 480x325 from 59,908 seeds (`synth --seed 3`): of
# the 75k Gaussians, quantiles 5, 25, 50, 75, 95 % of the opacity .007 .02 .12 .31 .78.
FITTED = Statistics(
    logit=(-2.1, 1.9),
    large=(0.05, 0.6),
    shrunk=(0.25, -0.8),
    gaps=(0.6, 0.55),
    sh=(0.023, 0.9),
    grown=1.25,
)


def town_level(shrink: int, *, width: int = 480, points: int = 60_000, seed: int = 3) -> BenchScene:
    """Return a town with the population and camera of one level of coarse-to-fine.

    Args:
        shrink: factor by which the photographs are smaller there: 4, 2 or 1.
        width: of the photographs, pixels.
        points: seeds.
        seed: of the town and the random numbers.
    """
    views = _drive_views(width)
    xyz, radiance = _surface_points(width, points, seed)
    gaussians = along_a_fit(xyz, radiance, views, WAY[shrink], np.random.default_rng([seed, 1]))
    view = next(v for v in views if v.name == "front/000001.png")
    size = max(round(view.width / shrink), 1), max(round(view.height / shrink), 1)
    K = np.diag([size[0] / view.width, size[1] / view.height, 1.0]) @ view.K
    camera = Camera(jnp.asarray(view.viewmat), jnp.asarray(K, jnp.float32), *size)
    return BenchScene(f"town 1/{shrink}", gaussians, camera)


def along_a_fit(
    xyz: Float[np.ndarray, "p 3"],
    radiance: Float[np.ndarray, "p 3"],
    views: list[View],
    way: float,
    rng: np.random.Generator,
    end: Statistics = FITTED,
) -> Gaussians:
    """Return seeds as a fit would have changed them.

    Args:
        xyz: seeds, scene units.
        radiance: of the seeds.
        views: training views.
        way: from the start, 0, to the end, 1.
        rng: random numbers.
        end: statistics at the end.
    """
    start = gaussians_from_points(xyz, radiance, views, FitConfig())
    clones = rng.choice(len(xyz), round(way * (end.grown - 1) * len(xyz)))
    leaves = {
        f.name: np.asarray(getattr(start, f.name), np.float64)[np.r_[: len(xyz), clones]]
        for f in dataclasses.fields(start)
        if getattr(start, f.name) is not None
    }
    count, near = len(xyz) + len(clones), leaves["log_scales"][:, 0].copy()
    logit = rng.normal(*end.logit, count)
    large = rng.normal(*end.large, count)
    shrunk = rng.random(count) < end.shrunk[0]
    large[shrunk] += end.shrunk[1] + rng.normal(0, 1, int(shrunk.sum()))
    gaps = [rng.exponential(mean, count) for mean in end.gaps]
    axes = large - np.stack([np.zeros(count), gaps[0], gaps[0] + gaps[1]])
    leaves["log_scales"] = near[:, None] + way * rng.permuted(axes.T, axis=1)
    leaves["opacity_logits"] += way * (logit - leaves["opacity_logits"])
    leaves["quats"] = leaves["quats"] + way * rng.normal(size=(count, 4))
    # Off the surface by part of the Gaussian's size, and more where relocation has put it.
    leaves["means"] += way * 0.5 * np.exp(near)[:, None] * rng.normal(size=(count, 3))
    size = end.sh[0] * np.exp(rng.normal(0, end.sh[1], (count, 1, 1)))
    leaves["sh"][:, 1:] = way * size * rng.normal(size=leaves["sh"][:, 1:].shape)
    arrays = {k: jnp.asarray(v, jnp.float32) for k, v in leaves.items()}
    return Gaussians(**arrays)  # pyright: ignore[reportArgumentType]


def _drive_views(width: int) -> list[View]:
    height = image_height(width)
    K = intrinsics(width, height).astype(np.float32)
    track = drive(FRAMES)
    return [
        View(
            name=(name := f"{camera}/{f:06d}.png"),
            image_path=_nowhere(name),
            camera=camera,
            viewmat=camera_viewmat(mount, track[f]).astype(np.float32),
            K=K,
            width=width,
            height=height,
        )
        for camera, mount in MOUNTS.items()
        for f in range(FRAMES)
    ]


def _nowhere(name: str) -> Path:
    return Path("nowhere") / name


@functools.lru_cache(maxsize=2)
def _surface_points(width: int, points: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return first hits at random pixels of the drive's views and their radiance."""
    town, rng = build_town(seed, "town"), np.random.default_rng([seed, 0])
    views = _drive_views(width)[:: FRAMES // SEEN_PER_CAMERA]
    each = -(-points // len(views))
    xyz, radiance = [], []
    for view in views:
        R, t = view.viewmat[:3, :3].astype(np.float64), view.viewmat[:3, 3].astype(np.float64)
        # Rays to the sky are dropped; enough others remain.
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


def _in_view(town: Town, view: View) -> Int[np.ndarray, " p"]:
    """Return the primitives that are not wholly behind the camera or beside its view."""
    corner = np.indices((2, 2, 2)).reshape(3, 8).T[:, None]
    corners = np.where(corner, town.hi, town.lo) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    x, _, z = np.moveaxis(corners, -1, 0)
    wide = view.width / (2 * view.K[0, 0])
    outside = (z < 0).all(0) | (x > wide * z).all(0) | (x < -wide * z).all(0)
    return np.flatnonzero(~outside)


def _first_hits(
    town: Town,
    origin: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, "r 3"],
    among: Int[np.ndarray, " p"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distances along rays (inf: sky), rows of the primitives `among`, and normals.

    Every primitive is taken as its bounding box: only number and size in the view matter.
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


# Corners, m: of the room, and of its furniture.
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
DETAIL = 2.5  # Gaussians on furniture, an area, over those on walls


def room(*, width: int = 500, points: int = 24_000, seed: int = 0) -> BenchScene:
    """Return a closed room from inside: long lists of splats that hide little.

    Args:
        width: image width, pixels; the height is three quarters of it.
        points: Gaussians.
        seed: of the random numbers.
    """
    rng = np.random.default_rng([seed, 2])
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
    # Behind the surface: outside of the room, inside of the furniture.
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
    """Return the view from a corner to the opposite one."""
    height = round(0.75 * width)
    center, target = np.array([-2.7, 1.7, 1.5]), np.array([1.5, -0.5, 0.9])
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    focal = 0.8 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return View(
        name="room.png",
        image_path=_nowhere("room.png"),
        camera="0",
        viewmat=viewmat.astype(np.float32),
        K=K.astype(np.float32),
        width=width,
        height=height,
    )
