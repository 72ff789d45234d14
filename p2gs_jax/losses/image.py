"""Photometric reconstruction: L1 and D-SSIM, masked and censored (paper, eq. 6).

SSIM's blurs are two banded matrix products each, the fastest form on a CPU (KERNEL.md), and its
gradient is written out: three more blurs instead of autodiff through five.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.config import LossConfig

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


@functools.lru_cache(maxsize=32)
def _band(size: int) -> np.ndarray:
    """Return the [size size] matrix that blurs one axis, zero-padded as 3DGS does."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    kernel = np.exp(-(offsets**2) / (2 * SIGMA**2))
    kernel /= kernel.sum()
    distance = np.arange(size)[:, None] - np.arange(size)[None, :]
    inside = np.abs(distance) <= WINDOW // 2
    return np.where(inside, kernel[np.clip(distance + WINDOW // 2, 0, WINDOW - 1)], 0.0)


def _blur(maps: Float[Array, "m h w"]) -> Float[Array, "m h w"]:
    height, width = maps.shape[-2:]
    rows = jnp.asarray(_band(height), maps.dtype)
    columns = jnp.asarray(_band(width), maps.dtype)
    return jnp.einsum("ij,mjk->mik", rows, maps @ columns)


def _moments(x, y):
    """Return the five blurred maps of SSIM, each [3 h w]."""
    return jnp.split(_blur(jnp.concatenate([x, y, x * x, y * y, x * y])), 5)


def _ssim_terms(x, y):
    mx, my, mxx, myy, mxy = _moments(x, y)
    a1, a2 = 2 * mx * my + C1, 2 * (mxy - mx * my) + C2
    b1, b2 = mx * mx + my * my + C1, mxx - mx * mx + myy - my * my + C2
    return mx, my, a1, a2, b1, b2


@jax.custom_vjp
def ssim_map(x: Float[Array, "3 h w"], y: Float[Array, "3 h w"]) -> Float[Array, "3 h w"]:
    """Return the SSIM map of two images, channels first (Wang et al. 2004; 11x11, sigma 1.5).

    The gradient flows to `x` only.
    """
    _, _, a1, a2, b1, b2 = _ssim_terms(x, y)
    return a1 * a2 / (b1 * b2)


def _ssim_fwd(x, y):
    terms = _ssim_terms(x, y)
    _, _, a1, a2, b1, b2 = terms
    return a1 * a2 / (b1 * b2), (x, y, *terms)


def _ssim_bwd(residuals, v):
    x, y, mx, my, a1, a2, b1, b2 = residuals
    s = a1 * a2 / (b1 * b2)
    # Derivatives to the blurred maps of x, x^2 and xy, everything else held.
    d_mxx = -s / b2
    d_mxy = 2 * a1 / (b1 * b2)
    d_mx = 2 * my * (a2 - a1) / (b1 * b2) - 2 * mx * s / b1 + 2 * mx * s / b2
    back = jnp.split(_blur(jnp.concatenate([v * d_mx, v * d_mxx, v * d_mxy])), 3)
    return back[0] + 2 * x * back[1] + y * back[2], jnp.zeros_like(y)


ssim_map.defvjp(_ssim_fwd, _ssim_bwd)


def ssim(
    ldr: Float[Array, "h w 3"], target: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, ""]:
    """Return the mean SSIM over valid pixels; invalid ones are black in both images."""
    x, y = ((a * mask[..., None]).transpose(2, 0, 1) for a in (ldr, target))
    return jnp.sum(ssim_map(x, y) * mask) / jnp.maximum(3 * jnp.sum(mask), 1.0)


def censor(
    ldr: Float[Array, "h w 3"], target: Float[Array, "h w 3"], saturation: float
) -> Float[Array, "h w 3"]:
    """Replace predictions that a saturated photograph cannot contradict by the photograph.

    Where the photograph is at or above `saturation` it only says "at least this bright": a
    prediction at least that bright is right and gets no gradient.
    """
    agrees = (target >= saturation) & (ldr >= saturation)
    return jnp.where(agrees, target, ldr)


def photometric_loss(
    ldr: Float[Array, "h w 3"],
    target: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    cfg: LossConfig,
) -> dict[str, Float[Array, ""]]:
    """Return the weighted terms `l1` and `dssim` (paper, eq. 6).

    Args:
        ldr: prediction, display-encoded, may exceed 1.
        target: photograph, [0, 1].
        mask: 1 = use; masked pixels get exactly zero gradient.
        cfg: weights and censoring.
    """
    if cfg.censored:
        ldr = censor(ldr, target, cfg.saturation)
    weight = cfg.dssim_weight or 0.0
    valid = jnp.maximum(3 * jnp.sum(mask), 1.0)
    absolute = jnp.where(mask[..., None] > 0, jnp.abs(ldr - target), 0.0)
    terms = {"l1": (1 - weight) * jnp.sum(absolute * mask[..., None]) / valid}
    if cfg.dssim_weight is not None:
        shown = jnp.where(mask[..., None] > 0, ldr, 0.0)
        terms["dssim"] = weight * (1 - ssim(shown, target, mask))
    return terms
