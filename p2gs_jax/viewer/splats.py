"""The scene as splats that the browser draws itself: fast, but with display colours only.

The browser composites display values instead of radiance, so soft edges differ a little from the
renderer's picture. viser has no spherical harmonics: colours are those seen from one place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.spatial.transform import Rotation
from scipy.special import expit

from p2gs_jax.config import RenderConfig
from p2gs_jax.formats.false_color import false_color
from p2gs_jax.gaussians.bake import display_of_splats
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render import view_radiance
from p2gs_jax.types import Camera, Gaussians
from p2gs_jax.viewer.picture_modes import MIDDLE_GREY, to_uint8_fast
from p2gs_jax.viewer.settings import Settings

# viser sends covariances as 16-bit floats, at most 65504.
LARGEST_DEVIATION = 250.0


@dataclass(frozen=True)
class BrowserSplats:
    """Splats in viewer units.

    Attributes:
        centers: of the Gaussians.
        covariances: of the Gaussians.
        opacities: peak, in [0, 1].
        linear: radiance towards one place.
    """

    centers: Float32[np.ndarray, "n 3"]
    covariances: Float32[np.ndarray, "n 3 3"]
    opacities: Float32[np.ndarray, "n 1"]
    linear: Float32[np.ndarray, "n 3"]


def browser_splats(
    gaussians: Gaussians,
    alive: Bool[np.ndarray, " n"],
    cfg: RenderConfig,
    *,
    seen_from: Float[np.ndarray, " 3"],
    unit: float,
) -> BrowserSplats:
    """Return live Gaussians as splats.

    Args:
        gaussians: the scene.
        alive: slots in use.
        cfg: activation of the radiance.
        seen_from: the place that their colours are seen from, scene units.
        unit: viewer units in a scene unit.
    """
    rows = np.flatnonzero(np.asarray(alive))
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, 3] = -np.asarray(seen_from)
    there = Camera(jnp.asarray(viewmat), jnp.eye(3), 1, 1)
    quats = np.asarray(gaussians.quats, float)[rows]
    quats[np.linalg.norm(quats, axis=1) < 1e-30] = (1, 0, 0, 0)
    scales = np.minimum(np.exp(np.asarray(gaussians.log_scales)[rows]) * unit, LARGEST_DEVIATION)
    axes = Rotation.from_quat(quats, scalar_first=True).as_matrix() * scales[:, None, :]
    logits = np.asarray(gaussians.opacity_logits, float)[rows]
    return BrowserSplats(
        (np.asarray(gaussians.means)[rows] * unit).astype(np.float32),
        (axes @ axes.transpose(0, 2, 1)).astype(np.float32),
        expit(logits)[:, None].astype(np.float32),
        np.asarray(jax.jit(partial(view_radiance, cfg=cfg))(gaussians, there))[rows],
    )


def splat_colors(
    splats: BrowserSplats, transform: DisplayTransform, settings: Settings
) -> UInt8[np.ndarray, "n 3"]:
    """Return a colour for each splat: false colour in mode `stops`, else display values.

    What depends on the place in the image is left out.
    """
    column = splats.linear[:, None]
    if settings.mode == "stops":
        return to_uint8_fast(false_color(column, MIDDLE_GREY / transform.exposure))[:, 0]
    return to_uint8_fast(develop(column, display_of_splats(transform)))[:, 0]
