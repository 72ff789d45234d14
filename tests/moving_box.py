"""A drive past a wall, in front of which a box crosses: photographs, laser points and a track."""

import itertools
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from splats import gaussians_of

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.scene.drives import DriveFormat
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.rigid import pose_of
from p2gs_jax.types import Camera, Gaussians, TrackedObject

WIDTH, HEIGHT, FOCAL = 160, 96, 110.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
FRAMES, INTERVAL, STEREO = 16, 0.1, 0.6
SIZE = (2.0, 1.2, 1.0)
# World: x right, y down, z forward, as of the first camera. Boxes: x forward, y left, z up.
BOX_TO_WORLD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
# The blur of 3DGS; the bounds in tests were measured on these photographs.
RENDER = RenderConfig(sh_degree=0, blur=0.3)


class World(NamedTuple):
    """A wall in the world, a box in object coordinates, its track, and exposures by frame."""

    wall: Gaussians
    box: Gaussians
    track: TrackedObject
    exposures: np.ndarray


def splats(means, log_scales, radiance) -> Gaussians:
    """Return opaque Gaussians of degree 0."""
    sh = np.log(np.asarray(radiance))[:, None] / 0.28209479177387814
    return gaussians_of(means, [1, 0, 0, 0], log_scales, 4.0, sh)


def pose_at(time: float) -> np.ndarray:
    """Return where the box is: it crosses to the right, and turns a little."""
    # The box is never parallel to an axis: equal depths have no order.
    turn = 0.1 + 0.15 * time
    c, s = np.cos(turn), np.sin(turn)
    rotation = BOX_TO_WORLD @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return pose_of(rotation, [-2.6 + 3.5 * time, 0.5, 6.0 - 0.4 * time])


def make_world() -> World:
    """Return a wall with ground before it, and a box with a checked pattern."""
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(-8, 8, 0.4), np.arange(-4, 1.2, 0.4))
    wall = np.stack([u.ravel(), v.ravel(), np.full(u.size, 10.0)], 1)
    u, w = np.meshgrid(np.arange(-7, 7, 0.4), np.arange(3.5, 10, 0.4))
    ground = np.stack([u.ravel(), np.full(u.size, 1.2), w.ravel()], 1)
    means = np.concatenate([wall, ground])
    radiance = rng.uniform(0.05, 0.5, (len(means), 3))
    still = splats(means, np.full(means.shape, np.log(0.17)), radiance)
    half = np.array(SIZE) / 2
    faces = []
    for axis in range(3):
        for sign in (-1, 1):
            lines = [np.arange(-h + 0.1, h, 0.2) for h in np.delete(half, axis)]
            flat = np.stack(np.meshgrid(*lines), -1).reshape(-1, 2)
            faces.append(np.insert(flat, axis, sign * half[axis], axis=1))
    means = np.concatenate(faces)
    checks = np.floor(means / 0.4 + 1e-6).astype(int).sum(1) % 2
    color = np.where(checks[:, None], [0.75, 0.7, 0.1], [0.05, 0.12, 0.5])
    box = splats(means, np.full(means.shape, np.log(0.09)), color)
    times = np.arange(FRAMES) * INTERVAL
    poses = np.stack([pose_at(t) for t in times])
    track = TrackedObject("box-1", "Car", SIZE, times, poses, moving=True)
    return World(still, box, track, np.exp2(rng.normal(0, 0.4, FRAMES)))


def moved(gaussians: Gaussians, pose: np.ndarray) -> Gaussians:
    """Return isotropic Gaussians of degree 0 at a pose."""
    means = np.asarray(gaussians.means) @ pose[:3, :3].T + pose[:3, 3]
    return Gaussians(jnp.asarray(means, jnp.float32), *jax.tree.leaves(gaussians)[1:])


def camera_pose(frame: int, camera: int) -> np.ndarray:
    """Return the camera-to-world matrix of one of two cameras that drive forward."""
    return pose_of(np.eye(3), [STEREO * (camera - 0.5), 0, 0.04 * frame])


def photographs(root: Path) -> list[Photograph]:
    """Return the photographs: their paths, times and poses."""
    return [
        Photograph(f"cam{k}", f, f * INTERVAL, root / f"cam{k}" / f"{f:03d}.png", camera_pose(f, k))
        for k, f in itertools.product(range(2), range(FRAMES))
    ]


def write_photographs(root: Path) -> None:
    """Write the photographs of the drive: sRGB of exposed radiance, 8 bits."""
    world, render = make_world(), make_renderer(RENDER)
    for photograph in photographs(root):
        box = moved(world.box, pose_at(photograph.time))
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), world.wall, box)
        viewmat = np.linalg.inv(photograph.pose).astype(np.float32)
        view = Camera(jnp.asarray(viewmat), jnp.asarray(K, jnp.float32), WIDTH, HEIGHT)
        shown = np.asarray(render(both, jnp.ones(both.capacity, bool), view).linear)
        encoded = srgb_encode(shown * world.exposures[photograph.frame])
        photograph.path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(photograph.path), np.rint(255 * encoded).astype(np.uint8)[..., ::-1])


def recording(root: Path) -> Recording:
    """Return the drive as a reader gives it; the box stays in sight."""
    world = make_world()
    cameras = tuple(RigCamera(f"cam{k}", K, WIDTH, HEIGHT) for k in range(2))

    def sweep(frame: int) -> SweepPoints:
        rng = np.random.default_rng((0, frame))
        time = frame * INTERVAL
        box = np.asarray(moved(world.box, pose_at(time)).means)
        found = np.concatenate([np.asarray(world.wall.means), box[rng.permutation(len(box))[:60]]])
        found = found + rng.normal(0, 0.01, found.shape)
        return SweepPoints(found.astype(np.float64), np.full(len(found), time))

    sweeps = tuple(Sweep(f * INTERVAL, lambda f=f: sweep(f)) for f in range(FRAMES))
    return Recording(root, "pandaset", cameras, photographs(root), sweeps, (world.track,))


def drive_format() -> DriveFormat:
    """Return a reader of this drive, which tests put in the place of a data set's reader."""
    return DriveFormat(("cam0",), lambda root, cfg: recording(root))
