"""Display colours of other people's splats as radiance: where their conversion begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.photometry.display import DisplayTransform, undevelop
from p2gs_jax.render.harmonics import C0, coefficient_count, radiance_preactivation
from p2gs_jax.types import Gaussians

# Display values beyond which a splat counts as saturated.
BRIGHTEST = 250.0 / 255.0


def relit(gaussians: Gaussians, shown: DisplayTransform, cfg: RenderConfig) -> Gaussians:
    """Return Gaussians with the radiance of their base colours, each by itself.

    What depends on the direction begins at nothing: in a model that knows no exposures it mostly
    tells one photograph's exposure from another's.

    Args:
        gaussians: display colours, 3DGS's: max(0, sh + 1/2).
        shown: how the photographs were taken, on average; nothing that depends on the place.
        cfg: activation and degree of the result.
    """
    colors = np.clip(0.5 + C0 * np.asarray(gaussians.sh[:, 0]), 0.0, BRIGHTEST)
    sh = np.zeros((len(colors), coefficient_count(cfg.sh_degree), 3), np.float32)
    sh[:, 0] = radiance_preactivation(undevelop(colors, shown), cfg.radiance) / C0
    return replace(gaussians, sh=on_device(sh))
