"""Scenes of the benches: splats with the statistics of streets."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from p2gs_jax.render.spherical_harmonics import C0
from p2gs_jax.types import Camera, Gaussians


class BenchScene(NamedTuple):
    """Gaussians and a camera.

    Attributes:
        name: what the tables call it.
        gaussians: the scene.
        camera: the view.
    """

    name: str
    gaussians: Gaussians
    camera: Camera


def _camera(width: int, height: int, focal: float) -> Camera:
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
    return Camera(jnp.eye(4), jnp.asarray(K), width, height)


def make_gaussians(means, quats, log_scales, logits, log_radiance, degree: int, rng) -> Gaussians:
    """Return Gaussians whose radiance of degree 0 is given; higher degrees are random."""
    sh = rng.normal(0, 0.1, (len(means), (degree + 1) ** 2, 3))
    # exp(C0 sh0) is the radiance seen from everywhere.
    sh[:, 0] = log_radiance / C0
    leaves = (means, quats, log_scales, logits, sh)
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in leaves))


def street(
    count: int,
    width: int,
    height: int,
    *,
    radius: float = 3.0,
    spread: float = 1.05,
    degree: int = 0,
    dynamic_range: float | None = None,
    seed: int = 0,
) -> BenchScene:
    """Return a canyon of ground, walls and backdrop: most splats near its surface, some behind.

    Args:
        count: number of Gaussians.
        width: image width, pixels.
        height: image height, pixels.
        radius: median radius at the 1/255 cutoff, pixels.
        spread: standard deviation of the log radius.
        degree: spherical-harmonics degree.
        dynamic_range: ratio of the largest to the smallest radiance, log-uniform in between;
            None draws radiances log-normally over about five stops.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
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
    if dynamic_range is None:
        log_radiance = rng.normal(-1, 1, (count, 3))
    else:
        log_radiance = rng.uniform(0, np.log(dynamic_range), (count, 1)) * np.ones(3)
    means = np.stack([dx * z, dy * z, z], -1)
    quats = rng.normal(size=(count, 4))
    gaussians = make_gaussians(means, quats, log_scales, logits, log_radiance, degree, rng)
    return BenchScene(f"street {count // 1000}k", gaussians, _camera(width, height, focal))
