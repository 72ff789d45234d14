"""`rasterization` with the names, shapes and meaning of gsplat, on the kernels of this package.

The interface follows `gsplat/rendering.py` (Ye et al., arXiv 2409.06765). Colours are linear
radiance and are not clamped from above.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import count_entries, project, render_splats
from p2gs_jax.render.capacity import PICTURES, bucket
from p2gs_jax.render.harmonics import coefficient_count
from p2gs_jax.render.project import view_radiance
from p2gs_jax.types import Camera, Gaussians

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
# Opacities are clipped this far from 0 and 1, where logits are infinite.
LEAST_OPACITY = 1e-7


def rasterization(
    means: Float[Array, "n 3"],
    quats: Float[Array, "n 4"],
    scales: Float[Array, "n 3"],
    opacities: Float[Array, " n"],
    colors: Float[Array, "..."],
    viewmats: Float[Array, "c 4 4"],
    Ks: Float[Array, "c 3 3"],
    width: int,
    height: int,
    *,
    near_plane: float | None = None,
    eps2d: float | None = None,
    sh_degree: int | None = None,
    backgrounds: Float[Array, "c 3"] | None = None,
    render_mode: str = "RGB",
    capacity: int | None = None,
    cfg: RenderConfig | None = None,
) -> tuple[Float[Array, "c h w x"], Float[Array, "c h w 1"], dict[str, Any]]:
    """Render Gaussians in several cameras of one size; differentiable, also in `jax.jit`.

    Means, scales (standard deviations) and `near_plane`, before which nothing is visible, are in
    scene units; quats are w x y z, of any length; opacities are in [0, 1]. Colours are linear
    radiance (n 3). With `sh_degree` they are spherical harmonics (n k 3) of radiance max(0, value +
    1/2); coefficients above the degree are ignored. Both may begin with an axis of cameras. View
    matrices map world to camera, OpenCV axes; `Ks` and the size are in pixels. `eps2d` is the
    variance added to the 2D covariance, pixels^2; backgrounds are radiance. None stands for the
    value in `cfg` (`near`, `blur`, `background`), or without `cfg` for gsplat's 0.01, 0.3, black.
    `cfg` has all other options; its `radiance` and `sh_degree` have no effect. The mode is "RGB",
    "D" (the sum of weights times z), "ED" ("D" over alpha), or RGB and one depth. The static
    `capacity` counts entries of the tile list; None measures it, outside of `jax.jit` only. Inside,
    pass `meta["capacity"]` of an earlier call.

    Returns:
        Colours with depth as their last channel, alphas, and a dictionary: `means2d` (c n 2),
        `depths` (c n), `radii` (c n 2: half the width and height of a splat above the alpha cutoff,
        pixels, 0 if invisible), `entries` (c), `overflow` (c: the image is incomplete and needs a
        larger capacity), `capacity`, `width` and `height`.

    Raises:
        ValueError: the mode or a shape is not valid, or the capacity is missing inside `jax.jit`.
    """
    if render_mode not in MODES:
        raise ValueError(f"render_mode {render_mode!r} is not valid: choose {', '.join(MODES)}")
    count, cameras = len(means), len(viewmats)
    for name, array, shape in (
        ("means", means, (count, 3)),
        ("quats", quats, (count, 4)),
        ("scales", scales, (count, 3)),
        ("opacities", opacities, (count,)),
        ("viewmats", viewmats, (cameras, 4, 4)),
        ("Ks", Ks, (cameras, 3, 3)),
        ("backgrounds", backgrounds, (cameras, 3)),
    ):
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} have shape {array.shape}: {shape} is needed")
    each = _for_each_camera(colors, count, cameras, sh_degree)
    cfg = cfg or RenderConfig(near=0.01, blur=0.3)
    cfg = dataclasses.replace(
        cfg,
        near=cfg.near if near_plane is None else near_plane,
        blur=cfg.blur if eps2d is None else eps2d,
        background=cfg.background if backgrounds is None else None,
        radiance="linear",
    )
    p, no_color = jnp.clip(opacities, LEAST_OPACITY, 1 - LEAST_OPACITY), jnp.zeros_like(means)
    logits = jnp.log(p) - jnp.log1p(-p)
    gaussians = Gaussians(means, quats, jnp.log(scales), logits, no_color[:, None])
    arrays, size = (gaussians, each, viewmats, Ks), (width, height)
    if capacity is None:
        capacity = _measured(arrays, size, cfg, sh_degree)
    options = size, cfg, capacity, sh_degree, render_mode != "RGB"
    rgb, alpha, depth, meta = _render(*arrays, *options)
    meta |= {"capacity": capacity, "width": width, "height": height}
    alpha = alpha[..., None]
    if backgrounds is not None:
        rgb = rgb + (1 - alpha) * backgrounds[:, None, None]
    parts = [rgb] if render_mode.startswith("RGB") else []
    if depth is not None:
        expected = render_mode.endswith("ED")
        parts.append(depth[..., None] / (jnp.maximum(alpha, 1e-10) if expected else 1.0))
    return jnp.concatenate(parts, -1), alpha, meta


def _for_each_camera(colors, count: int, cameras: int, sh_degree: int | None):
    """Return colours (c n 3), or coefficients in use (c n k 3); ValueError: another shape."""
    kept, shape = colors, (count, 3)
    if sh_degree is not None:
        bands = coefficient_count(sh_degree)
        kept, shape = colors[..., :bands, :], (count, bands, 3)
    if kept.shape not in (shape, (cameras, *shape)):
        raise ValueError(f"colors have shape {colors.shape}: {shape} is needed, or one per camera")
    return jnp.broadcast_to(kept, (cameras, *shape))


def _splatted(gaussians, each, size, cfg: RenderConfig, sh_degree: int | None):
    """Return the camera of a view, the splats in it, and their radiance."""
    color, viewmat, K = each
    camera = Camera(viewmat, K, *size)
    splats = project(gaussians, jnp.ones(gaussians.means.shape[0], bool), camera, cfg)
    if sh_degree is not None:
        color = view_radiance(dataclasses.replace(gaussians, sh=color), camera, cfg)
    return camera, splats, color


@functools.partial(jax.jit, static_argnums=(4, 5, 6, 7, 8))
def _render(gaussians, colors, viewmats, Ks, size, cfg, capacity, sh_degree, with_depth):
    """Return radiance, alpha, depth (c h w) or None, and the dictionary of `rasterization`."""

    def one(each):
        camera, splats, color = _splatted(gaussians, each, size, cfg, sh_degree)
        result = render_splats(splats, color, camera, cfg, capacity, with_depth=with_depth)
        reach = jnp.maximum(splats.log_opacities - float(np.log(cfg.alpha_cutoff)), 0)
        radii = jnp.ceil(jnp.sqrt(2 * reach[:, None] * splats.cov_diagonal))
        meta = {
            "means2d": splats.means2d,
            "depths": splats.depths,
            "radii": jnp.where(splats.visible[:, None], radii, 0).astype(jnp.int32),
            "entries": result.count,
            "overflow": result.overflow,
        }
        return result.linear, result.alpha, result.depth, meta

    return jax.lax.map(one, (colors, viewmats, Ks))


@functools.partial(jax.jit, static_argnums=(4, 5, 6))
def _entries(gaussians, colors, viewmats, Ks, size, cfg, sh_degree):
    """Return the number of entries that each camera needs."""

    def one(each):
        camera, splats, _ = _splatted(gaussians, each, size, cfg, sh_degree)
        return count_entries(splats, camera.width, camera.height, cfg)

    return jax.lax.map(one, (colors, viewmats, Ks))


def _measured(arrays: tuple, size: tuple[int, int], cfg: RenderConfig, degree: int | None) -> int:
    """Return a capacity for these cameras, with a margin; ValueError: traced values (`jax.jit`)."""
    fixed: tuple = jax.lax.stop_gradient(arrays)
    try:
        needed = int(jnp.max(_entries(*fixed, size, cfg, degree)))
    except jax.errors.ConcretizationTypeError as error:
        raise ValueError(
            "the capacity of the tile list cannot be measured inside jax.jit: pass capacity=, "
            'such as meta["capacity"] of a call outside of jax.jit'
        ) from error
    return bucket(needed, PICTURES)
