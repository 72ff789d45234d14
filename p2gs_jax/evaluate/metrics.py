"""Image and HDR metrics (paper, appendix Metrics; docs/photometry.md, 6)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.losses.image import ssim as _ssim


@jax.jit
def psnr(
    ldr: Float[Array, "h w 3"], target: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, ""]:
    """Return the peak signal-to-noise ratio over valid pixels, dB, peak 1."""
    squared = jnp.sum(mask[..., None] * (ldr - target) ** 2)
    mse = squared / jnp.maximum(3 * jnp.sum(mask), 1)
    return -10 * jnp.log10(jnp.maximum(mse, 1e-12))


ssim = jax.jit(_ssim)


def hdr_error_stops(
    linear: Float[np.ndarray, "... 3"], truth: Float[np.ndarray, "... 3"], mask=None
) -> dict[str, float]:
    """Return median and RMS |log2(L / L_true)| after scale alignment, each capped at 3 stops.

    Args:
        linear: recovered radiance.
        truth: true radiance; pixels where it is 0 are left out.
        mask: which pixels count (last axis excluded), None for all.
    """
    keep = (truth > 0) & (linear > 0)
    if mask is not None:
        keep &= np.asarray(mask, bool)[..., None]
    if not keep.any():
        return {"median": float("nan"), "rms": float("nan")}
    stops = np.log2(linear[keep].astype(np.float64)) - np.log2(truth[keep].astype(np.float64))
    stops = np.minimum(np.abs(stops - np.median(stops)), 3.0)
    return {"median": float(np.median(stops)), "rms": float(np.sqrt(np.mean(stops**2)))}
