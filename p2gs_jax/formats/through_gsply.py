"""Gaussians with display colours as the package gsply takes them."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from p2gs_jax.errors import UserError
from p2gs_jax.types import Gaussians


def require_gsply() -> ModuleType:
    """Return the package that writes SPZ and compressed PLY.

    Raises:
        UserError: it is not installed.
    """
    try:
        import gsply
    except ImportError as error:
        raise UserError(
            f"SPZ and compressed PLY need the package gsply, which cannot be imported ({error}).",
            fix="pip install 'p2gs-jax[spz]', or convert display.ply with another tool "
            "(docs/exports.md)",
        ) from error
    return gsply


def gsply_data(gaussians: Gaussians) -> Any:
    """Return Gaussians as gsply's own record, quaternions of length 1.

    Raises:
        UserError: gsply is not installed.
    """
    g = gaussians
    quats = np.asarray(g.quats, np.float32)
    return require_gsply().GSData.from_arrays(
        means=np.asarray(g.means),
        scales=np.asarray(g.log_scales),
        quats=quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12),
        opacities=np.asarray(g.opacity_logits),
        sh0=np.asarray(g.sh[:, 0]),
        shN=np.asarray(g.sh[:, 1:]) if g.sh.shape[1] > 1 else None,
        format="ply",
    )
