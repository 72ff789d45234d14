"""The HDR score of HDR-NeRF and GaussHDR: PSNR after tone mapping by the mu law."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# GaussHDR (CVPR 2025) and HDR-NeRF (CVPR 2022): log(1 + mu x) / log(1 + mu), mu = 5000.
MU = 5000.0


def mu_law(x: Float[np.ndarray, "..."], mu: float = MU) -> Float[np.ndarray, "..."]:
    """Return radiance compressed by the mu law, in [0, 1].

    Args:
        x: radiance over the brightest; clipped to [0, 1].
        mu: how strongly dark values are spread.
    """
    return np.log1p(mu * np.clip(x, 0.0, 1.0)) / np.log1p(mu)


def mu_law_psnr(
    linear: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    mu: float = MU,
) -> float:
    """Return PSNR of tone-mapped radiance, dB, as GaussHDR's code computes it for synthetic scenes.

    Both images are divided by the brightest true channel of the view. Its authors write both as
    8-bit files first, which this does not.

    Args:
        linear: recovered radiance, aligned to the truth by one scale common to all views.
        truth: true radiance.
        mask: which pixels count.
        mu: of the mu law.

    Returns:
        NaN where no pixel counts, or the truth is black.
    """
    brightest = float(truth[mask].max()) if mask.any() else 0.0
    if brightest <= 0:
        return float("nan")
    a, b = (mu_law(x[mask].astype(np.float64) / brightest, mu) for x in (linear, truth))
    return float(-10 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-12)))
