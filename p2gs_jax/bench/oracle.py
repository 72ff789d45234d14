"""The float64 truth of whole images: the dense reference, block by block.

The reference composites every splat at every pixel. A block of pixels only needs the splats whose
ellipse touches it, so the same few lines judge scenes of a hundred thousand splats.
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
from p2gs_jax.render import project, rasterize, view_radiance
from p2gs_jax.render.cutoff import with_cutoffs
from p2gs_jax.types import Camera, Gaussians, Splats2D

BLOCK = (32, 24)
# Below this opacity a contribution is far beneath float32's resolution of the image.
NEGLIGIBLE = 1e-9


class Truth(NamedTuple):
    """The float64 image of a scene and its gradient.

    Attributes:
        linear: radiance, (H, W, 3), float64.
        gradient: of the sum of `linear` times the cotangent, float64 leaves.
    """

    linear: Float[np.ndarray, "h w 3"]
    gradient: Gaussians


def untruncated(cfg: RenderConfig) -> RenderConfig:
    """Return the options under which nothing is left out."""
    return dataclasses.replace(
        cfg, alpha_cutoff=NEGLIGIBLE, cutoff_rule="opacity", stop_error=None, exp_degree=None
    )


def truth(
    gaussians: Gaussians,
    camera: Camera,
    cfg: RenderConfig,
    cotangent: Float[np.ndarray, "h w 3"],
    window: tuple[slice, slice] | None = None,
) -> Truth:
    """Return image and gradient in float64 under the cutoffs of `cfg`, without a stop rule.

    Args:
        gaussians: the scene.
        camera: the view.
        cfg: cutoffs and limits; see `untruncated`.
        cotangent: weight of each value in the objective whose gradient is taken.
        window: rows and columns to compute, for images too large; the rest stays black, and its
            weights must be zero. None computes all.
    """
    with jax.enable_x64(True):
        scene, view = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), (gaussians, camera))
        (leaves, radiance), pull, splats = jax.vjp(
            lambda g: _prepared(g, view, cfg), scene, has_aux=True
        )
        rows, columns = window or (slice(0, camera.height), slice(0, camera.width))
        linear, v_leaves, v_radiance = _blocks(
            splats, leaves, radiance, camera, cfg, cotangent, rows, columns
        )
        (gradient,) = pull((v_leaves, v_radiance))
        return Truth(linear, jax.tree.map(np.asarray, gradient))


def _prepared(gaussians: Gaussians, view: Camera, cfg: RenderConfig):
    radiance = view_radiance(gaussians, view, cfg)
    alive = jnp.ones(gaussians.capacity, bool)
    s = with_cutoffs(project(gaussians, alive, view, cfg), radiance, cfg)
    return ((s.means2d, s.conic_factor, s.log_opacities), radiance), s


@functools.partial(jax.jit, static_argnames=("cfg",))
def _block(splats: Splats2D, leaves, radiance, origin, v, cfg: RenderConfig):
    def run(leaves, radiance):
        s = dataclasses.replace(
            splats,
            means2d=leaves[0] - origin,
            conic_factor=leaves[1],
            log_opacities=leaves[2],
        )
        return rasterize(s, radiance, None, *BLOCK, cfg, implementation="reference")[0]

    linear, pull = jax.vjp(run, leaves, radiance)
    return linear, pull(v)


def _blocks(splats, leaves, radiance, camera, cfg, cotangent, rows: slice, columns: slice):
    means, cov = np.asarray(splats.means2d), np.asarray(splats.cov_diagonal)
    room = np.asarray(splats.log_opacities) - np.asarray(splats.log_cutoffs)
    shown = np.asarray(splats.visible) & (room > 0)
    reach = np.sqrt(2 * np.maximum(room, 0)[:, None] * cov)
    low, high = means - reach, means + reach
    width, height = camera.width, camera.height
    linear = np.zeros((height, width, 3))
    totals = [np.zeros(a.shape) for a in (*leaves, radiance)]
    for y in range(rows.start, rows.stop, BLOCK[1]):
        in_row = shown & (high[:, 1] > y) & (low[:, 1] < y + BLOCK[1])
        for x in range(columns.start, columns.stop, BLOCK[0]):
            chosen = np.flatnonzero(in_row & (high[:, 0] > x) & (low[:, 0] < x + BLOCK[0]))
            if not len(chosen):
                continue
            padded = 256
            while padded < len(chosen):
                padded *= 2
            index = np.concatenate([chosen, np.zeros(padded - len(chosen), int)])
            used = jnp.arange(padded) < len(chosen)
            pick = lambda a: a[index]  # noqa: B023, E731
            s = jax.tree.map(pick, splats)
            s = dataclasses.replace(s, visible=used)
            part = (*map(pick, leaves[:2]), jnp.where(used, leaves[2][index], -100.0))
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
