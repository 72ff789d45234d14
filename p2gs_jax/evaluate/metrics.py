"""Image metrics (paper, appendix Metrics; docs/photometry.md, 6)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.evaluate.ssim import ssim as _ssim


@jax.jit
def psnr(
    ldr: Float[Array, "h w 3"], target: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, ""]:
    """Return the peak signal-to-noise ratio over valid pixels, dB, peak 1."""
    squared = jnp.sum(mask[..., None] * (ldr - target) ** 2)
    mse = squared / jnp.maximum(3 * jnp.sum(mask), 1)
    return -10 * jnp.log10(jnp.maximum(mse, 1e-12))


ssim = jax.jit(_ssim)
