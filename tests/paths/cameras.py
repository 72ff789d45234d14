"""Cameras for tests."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from p2gs_jax.paths.shots import Shot
from p2gs_jax.types import View


def turned(yaw=0.0, center=(0.0, 0.0, 0.0), pitch=0.0, roll=0.0):
    """Return a world-to-camera matrix, y down; angles in degrees, yaw to the right."""
    pose = Rotation.from_euler("YXZ", [yaw, pitch, roll], degrees=True).as_matrix()
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = pose.T, -pose.T @ np.asarray(center, float)
    return viewmat


def shot(viewmat, name="0", fov=60.0, width=64, height=48, **more):
    f = width / 2 / np.tan(np.deg2rad(fov) / 2)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return Shot(name, viewmat, K, width, height, **more)


def view(name, viewmat, width=64, height=48):
    s = shot(viewmat, width=width, height=height)
    camera = name.rsplit("/", 1)[0] if "/" in name else "0"
    return View(name, Path(name), camera, viewmat, s.K, width, height)


def directions(shot):
    """Return world directions through the pixels of a pinhole camera."""
    x, y = np.meshgrid(np.arange(shot.width) + 0.5, np.arange(shot.height) + 0.5)
    xy = (np.stack([x, y], -1) - shot.K[:2, 2]) / shot.K[[0, 1], [0, 1]]
    return np.concatenate([xy, np.ones_like(x)[..., None]], -1) @ shot.viewmat[:3, :3]
