"""Photographs of noise from four camera positions, and Gaussians that a view shows in part."""

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.presets import with_values
from p2gs_jax.train.exposure_loss import Partner
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Photometry

COUNT, VIEWS = 500, 4
WIDTH, HEIGHT, FOCAL = 48, 32, 45.0
EXTENT, DEGREE = 2.0, 1


def config(method: str | None = "mcmc", batch: int = 1) -> FitConfig:
    # Without DSSIM the programs compile faster. Adam's epsilon is about as large as the gradient,
    # so that updates are as smooth as the gradient.
    fields = {"loss.dssim_weight": None, "optimizer.eps": 1e-5, "densify.method": method}
    fields |= {"render.sh_degree": DEGREE, "render.pixels_in_flight": 2048, "train.batch": batch}
    return with_values(FitConfig(), fields)


def start(count: int = COUNT, spread: float = 0.9, behind: int = 0) -> Params:
    """Return parameters of Gaussians; the first `behind` of them lie behind all cameras."""
    rng = np.random.default_rng(0)
    z = rng.uniform(3, 8, count)
    xy = rng.uniform(-spread, spread, (count, 2)) * z[:, None] * [WIDTH / FOCAL, HEIGHT / FOCAL]
    z[:behind] *= -1
    values = (
        np.concatenate([xy, z[:, None]], 1),
        rng.normal(size=(count, 4)),
        rng.normal(-3, 0.4, (count, 3)),
        rng.normal(-1, 2, count),
        rng.normal(0, 0.3, (count, (DEGREE + 1) ** 2, 3)),
    )
    zeros = np.zeros(VIEWS, np.float32)
    gaussians = on_host(Gaussians, *(a.astype(np.float32) for a in values))
    return on_host(Params, gaussians, on_host(Photometry, zeros + 0.1, zeros))


def view(row: int) -> tuple[Batch, Partner]:
    """Return a photograph of noise from the camera position of a row, and its partner."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3] = 1.5 * row - 2
    camera = on_host(Camera, pose, K, WIDTH, HEIGHT)
    ldr = np.random.default_rng(row).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    batch = on_host(Batch, camera, ldr, np.ones((HEIGHT, WIDTH), bool), np.int32(row))
    return batch, on_host(Partner, np.int32(0))
