"""The float64 image and gradient of a whole scene, and the errors of a float32 render against them.

The dense reference composites every splat at every pixel. A block of pixels needs only the splats
whose ellipse touches it, so the reference can test scenes of 100,000 splats.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.render import project, rasterize
from p2gs_jax.render.project import view_radiance
from p2gs_jax.types import Camera, Gaussians, Splats2D

BLOCK = (32, 24)
# A smaller alpha contributes far less than float32's resolution of the image.
NEGLIGIBLE = 1e-9
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
# Relative errors of pixels darker than this share of the largest radiance are relative to that
# level.
DARKEST = 1e-4


class Truth(NamedTuple):
    """The float64 image of a scene and its gradient.

    Attributes:
        linear: radiance, (H, W, 3), float64.
        gradient: gradient of the sum of `linear` times the cotangent, float64 leaves.
    """

    linear: Float[np.ndarray, "h w 3"]
    gradient: Gaussians


def untruncated(cfg: RenderConfig) -> RenderConfig:
    """Return the options without cutoff, stop rule and approximate exponential."""
    return dataclasses.replace(cfg, alpha_cutoff=NEGLIGIBLE, stop_error=None, exp_degree=None)


def truth(
    gaussians: Gaussians, camera: Camera, cfg: RenderConfig, cotangent: Float[np.ndarray, "h w 3"]
) -> Truth:
    """Return image and gradient in float64 with the cutoff of `cfg`, without a stop rule.

    The gradient is that of the sum of the image times `cotangent`. See `untruncated`.
    """
    with jax.enable_x64(True):
        scene, view = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), (gaussians, camera))
        (leaves, radiance), pull, splats = jax.vjp(
            lambda g: _prepared(g, view, cfg), scene, has_aux=True
        )
        linear, v_leaves, v_radiance = _blocks(splats, leaves, radiance, camera, cfg, cotangent)
        (gradient,) = pull((v_leaves, v_radiance))
        return Truth(linear, jax.tree.map(np.asarray, gradient))


def _prepared(gaussians: Gaussians, view: Camera, cfg: RenderConfig):
    radiance = view_radiance(gaussians, view, cfg)
    alive = jnp.ones(gaussians.capacity, bool)
    s = project(gaussians, alive, view, cfg)
    return ((s.means2d, s.conic_factor, s.log_opacities), radiance), s


@functools.partial(jax.jit, static_argnames=("cfg",))
def _block(splats: Splats2D, leaves, radiance, origin, v, cfg: RenderConfig):
    cfg = dataclasses.replace(cfg, implementation="reference")

    def run(leaves, radiance):
        means, factor, opacities = leaves
        s = dataclasses.replace(
            splats, means2d=means - origin, conic_factor=factor, log_opacities=opacities
        )
        return rasterize(s, radiance, None, *BLOCK, cfg)[0]

    linear, pull = jax.vjp(run, leaves, radiance)
    return linear, pull(v)


def _blocks(splats, leaves, radiance, camera, cfg, cotangent):
    means, cov = np.asarray(splats.means2d), np.asarray(splats.cov_diagonal)
    reach = np.asarray(splats.log_opacities) - np.log(cfg.alpha_cutoff)
    visible = np.asarray(splats.visible) & (reach > 0)
    radius = np.sqrt(2 * np.maximum(reach, 0)[:, None] * cov)
    low, high = means - radius, means + radius
    width, height = camera.width, camera.height
    linear = np.zeros((height, width, 3))
    totals = [np.zeros(a.shape) for a in (*leaves, radiance)]
    for y in range(0, height, BLOCK[1]):
        in_row = visible & (high[:, 1] > y) & (low[:, 1] < y + BLOCK[1])
        for x in range(0, width, BLOCK[0]):
            chosen = np.flatnonzero(in_row & (high[:, 0] > x) & (low[:, 0] < x + BLOCK[0]))
            if not len(chosen):
                continue
            padded = 256
            while padded < len(chosen):
                padded *= 2
            index = np.concatenate([chosen, np.zeros(padded - len(chosen), int)])
            used = jnp.arange(padded) < len(chosen)
            s = jax.tree.map(lambda a, i=index: a[i], splats)
            s = dataclasses.replace(s, visible=used)
            part = (leaves[0][index], leaves[1][index], jnp.where(used, leaves[2][index], -100.0))
            h, w = min(BLOCK[1], height - y), min(BLOCK[0], width - x)
            v = np.zeros((BLOCK[1], BLOCK[0], 3))
            v[:h, :w] = cotangent[y : y + h, x : x + w]
            image, (v_part, v_radiance) = _block(
                s, part, radiance[index], jnp.array([x, y], float), jnp.asarray(v), cfg
            )
            linear[y : y + h, x : x + w] = np.asarray(image)[:h, :w]
            for total, value in zip(totals, (*v_part, v_radiance), strict=True):
                total[chosen] += np.asarray(value)[: len(chosen)]
    return linear, tuple(map(jnp.asarray, totals[:3])), jnp.asarray(totals[3])


def _relative(error: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the error of each pixel relative to its brightest channel."""
    brightest = exact.max(-1)
    return error.max(-1) / np.maximum(brightest, DARKEST * brightest.max())


def errors(
    linear: Float[np.ndarray, "h w 3"], gradient: Gaussians, truth: Truth
) -> dict[str, float]:
    """Return the accuracy metrics of a render and its gradient.

    `max_abs` is in linear radiance, exposed so that the mean of the truth is 0.18. `relative` is
    the largest error of a pixel relative to its brightest channel. `psnr` (dB) compares the sRGB
    encodings of the exposed images. `gradient` is the relative L2 error of the worst parameter
    group.
    """
    exact = truth.linear
    exposure = 0.18 / max(float(exact.mean()), 1e-30)
    error = np.abs(linear - exact)
    mse = np.mean((srgb_encode(linear * exposure) - srgb_encode(exact * exposure)) ** 2)
    groups = []
    for name in FIELDS:
        a, b = np.asarray(getattr(gradient, name), np.float64), getattr(truth.gradient, name)
        groups.append(np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-30))
    return {
        "max_abs": float(error.max() * exposure),
        "relative": float(_relative(error, exact).max()),
        "psnr": float(-10 * np.log10(max(mse, 1e-30))),
        "gradient": float(max(groups)),
    }


def trimmed_errors(
    linear: Float[np.ndarray, "h w 3"], gradient: Gaussians, truth: Truth
) -> dict[str, float]:
    """Return accuracy without the worst 1 % of the pixels and of the Gaussians.

    Where a pixel has many splats, some contributions lie exactly at the cutoff, and float32 and
    float64 may decide differently. A few of these would dominate the metrics.
    """
    relative = _relative(np.abs(linear - truth.linear), truth.linear)
    groups = []
    for name in FIELDS:
        a, b = np.asarray(getattr(gradient, name), np.float64), getattr(truth.gradient, name)
        error = np.linalg.norm((a - b).reshape(len(a), -1), axis=1)
        kept = error[error <= np.quantile(error, 0.99)]
        groups.append(np.linalg.norm(kept) / max(np.linalg.norm(b), 1e-30))
    return {"relative_99": float(np.quantile(relative, 0.99)), "gradient_99": float(max(groups))}
