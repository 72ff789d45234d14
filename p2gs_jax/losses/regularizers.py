"""What fixes the gauges, and what keeps the population lean. Every term can be left out."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from p2gs_jax.config import FitConfig, RegularizerConfig
from p2gs_jax.gaussians.population import opacities
from p2gs_jax.render.objects import correction_at
from p2gs_jax.types import GAMMA_SRGB, Gaussians, Photometry, Placement

# Boxes are drawn about as well as this: radians, and metres.
ROTATION_DEVIATION, TRANSLATION_DEVIATION = 0.02, 0.1


def variance(x: Float[Array, " v"]) -> Float[Array, ""]:
    """Return the population variance in two passes: exact at large means, smooth at zero."""
    return jnp.mean((x - jnp.mean(x)) ** 2)


def photometry_regularizers(
    photometry: Photometry, cfg: RegularizerConfig
) -> dict[str, Float[Array, ""]]:
    """Return the weighted terms on exposures and gammas.

    The paper's three (eq. 10) resolve: global scale; spread (which also shrinks true spread, see
    docs/photometry.md, 3); tone. Ours resolve: the scale gauge alone; the power gauge.
    """
    e, gamma = photometry.exposures, photometry.gammas
    terms = {}
    if cfg.exposure_scale is not None:
        terms["exposure_scale"] = cfg.exposure_scale * jnp.mean((e - 1) ** 2)
    if cfg.exposure_variance is not None:
        terms["exposure_variance"] = cfg.exposure_variance * variance(e)
    if cfg.gamma_prior is not None:
        terms["gamma_prior"] = cfg.gamma_prior * jnp.mean((gamma - GAMMA_SRGB) ** 2)
    if cfg.log_exposure_mean is not None:
        mean = jnp.mean(photometry.log_exposures)
        terms["log_exposure_mean"] = cfg.log_exposure_mean * mean**2
    if cfg.gamma_mean_variance is not None:
        terms["gamma_mean_variance"] = cfg.gamma_mean_variance * (
            (jnp.mean(gamma) - GAMMA_SRGB) ** 2 + variance(gamma)
        )
    return terms


def opacity_regularizer(
    gaussians: Gaussians, alive: Bool[Array, " n"], count: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the mean opacity of live Gaussians (3DGS-MCMC).

    Args:
        gaussians: all that count, or some of them for their share of the mean.
        alive: slots in use.
        count: how many the mean is over.
    """
    return jnp.sum(jnp.where(alive, opacities(gaussians), 0.0)) / count


def scale_regularizer(
    gaussians: Gaussians, alive: Bool[Array, " n"], extent: float, count: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the mean scale of live Gaussians in scene extents (3DGS-MCMC); see above."""
    scales = jnp.where(alive[:, None], jnp.exp(gaussians.log_scales), 0.0)
    return jnp.sum(scales) / (3 * extent * count)


def population_terms(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    cfg: FitConfig,
    extent: float,
    count: Float[Array, ""] | None = None,
) -> dict[str, Float[Array, ""]]:
    """Return the weighted terms on the Gaussians themselves, as MCMC wants them.

    Args:
        gaussians: all that count, or some of them for their share.
        alive: slots in use.
        cfg: weights; a weight of None keeps its term out of the trace.
        extent: scene extent, scene units.
        count: how many the means are over; None: the live ones given.
    """
    if cfg.densify.method != "mcmc":
        return {}
    reg, terms = cfg.loss.regularizers, {}
    over = jnp.maximum(jnp.sum(alive) if count is None else count, 1).astype(jnp.float32)
    if reg.opacity is not None:
        terms["opacity"] = reg.opacity * opacity_regularizer(gaussians, alive, over)
    if reg.scale is not None:
        terms["scale"] = reg.scale * scale_regularizer(gaussians, alive, extent, over)
    return terms


def pose_terms(
    poses: Float[Array, "t k 6"] | None, objects: Placement | None, cfg: RegularizerConfig
) -> dict[str, Float[Array, ""]]:
    """Return the weighted prior on corrections of poses: boxes are where they were drawn.

    Args:
        poses: corrections at key times.
        objects: those of the view; what is not there does not count.
        cfg: a weight of None keeps the term out of the trace.
    """
    if poses is None or objects is None or cfg.object_poses is None:
        return {}
    deviations = jnp.repeat(jnp.array([ROTATION_DEVIATION, TRANSLATION_DEVIATION]), 3)
    apart = correction_at(poses, objects.key, objects.share) / deviations
    there = jnp.any(objects.viewmats[:, :3, :3] != 0, axis=(1, 2))
    each = jnp.where(there, jnp.sum(apart**2, -1), 0.0)
    return {"object_poses": cfg.object_poses * jnp.sum(each)}
