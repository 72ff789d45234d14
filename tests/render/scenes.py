"""Small made-up scenes that several rendering tests share."""

import jax.numpy as jnp
import numpy as np

from p2gs_jax.types import Camera, Gaussians


def street(n=1500, width=72, height=53, seed=3, radius=6.0, degree=1, dtype=np.float32):
    """Return Gaussians with street-like depths, sizes, opacities and radiances, and a camera."""
    rng = np.random.default_rng(seed)
    focal = 0.75 * width
    u, v = rng.uniform(-0.05, 1.05, (2, n)) * np.array([[width], [height]])
    dx, dy = (u - width / 2) / focal, (v - height / 2) / focal
    ground = np.where(dy > 0.02, 1.6 / np.maximum(dy, 0.02), 80.0)
    surface = np.minimum(np.minimum(ground, 7 / np.maximum(np.abs(dx), 0.08)), 90.0)
    z = np.clip(surface * np.exp(rng.normal(0, 0.3, n)), 1.0, 150.0)
    logits = rng.normal(0, 2, n)
    reach = np.sqrt(np.maximum(2 * np.log(255 / (1 + np.exp(-logits))), 0.5))
    sigma = radius * np.exp(rng.normal(0, 0.8, n)) / reach * z / focal
    sh = rng.normal(0, 0.4, (n, (degree + 1) ** 2, 3))
    sh[:, 0] += rng.normal(-1, 1, (n, 3))
    quats, means = rng.normal(size=(n, 4)), np.stack([dx * z, dy * z, z], -1)
    values = means, quats, np.log(sigma)[:, None] + rng.normal(0, 0.5, (n, 3)), logits, sh
    gaussians = Gaussians(*(jnp.asarray(a, dtype) for a in values))
    return gaussians, camera(width, height, focal, dtype=dtype)


def camera(width=72, height=53, focal=54.0, viewmat=None, dtype=np.float32):
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pose = np.eye(4) if viewmat is None else viewmat
    return Camera(jnp.asarray(pose, dtype), jnp.asarray(K, dtype), width, height)
