"""Small sets of Gaussians and a camera for tests."""

import jax.numpy as jnp
import numpy as np

from p2gs_jax import Camera, DisplayTransform, Gaussians, Render
from p2gs_jax.config import PhotometryConfig

SRGB = DisplayTransform(1.0, 2.2, PhotometryConfig())


def gaussians_of(means, quats, log_scales, opacity_logits, sh):
    """Return Gaussians of these arrays; a single row is repeated for all."""
    n, values = len(means), (means, quats, log_scales, opacity_logits, sh)
    shapes = (n, 3), (n, 4), (n, 3), (n,), (n, *np.shape(sh)[-2:])
    pairs = zip(values, shapes, strict=True)
    return Gaussians(*(jnp.asarray(np.broadcast_to(a, s), jnp.float32) for a, s in pairs))


def random_splats(n=50, degree=3, seed=0):
    """Return Gaussians whose every parameter is drawn from a normal distribution."""
    rng = np.random.default_rng(seed)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, (degree + 1) ** 2, 3)]
    return gaussians_of(*(rng.normal(size=s) for s in shapes))


def haze(n=120, degree=1, seed=0):
    """Return translucent Gaussians of very different radiance along +z; the last is a dark wall."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1, -1, 2], [1, 1, 4], (n, 3))
    sh = rng.normal(0, 0.1, (n, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.normal(-4, 6, (n, 1))
    log_scales = rng.normal(-1.5, 0.3, (n, 3))
    means[-1], log_scales[-1], sh[-1, 0] = (0, 0, 6), (2, 2, -3), -12
    quats, logits = rng.normal(size=(n, 4)), rng.normal(-1, 1, n)
    quats[-1] = 1, 0, 0, 0
    return gaussians_of(means, quats, log_scales, logits, sh)


def camera(x=0.0, width=40, height=32, focal=30.0, yaw=0.0):
    """Return a camera at (x, 0, 0) that looks along +z, or turned by `yaw` about y."""
    c, s = np.cos(yaw), np.sin(yaw)
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    viewmat[:3, 3] = -viewmat[:3, :3] @ [x, 0, 0]
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    return Camera(jnp.asarray(viewmat), jnp.asarray(K), width, height)


def rendered(linear, alpha=None, depth=None):
    """Return a render of these images, opaque by default."""
    alpha = jnp.ones(linear.shape[:2]) if alpha is None else alpha
    return Render(linear, alpha, depth, jnp.int32(0), jnp.bool_(False), jnp.zeros(0, bool))
