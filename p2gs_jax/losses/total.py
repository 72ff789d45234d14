"""The composed loss (paper, eq. 7): one differentiable function of the one parameter pytree."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.losses.image import photometric_loss
from p2gs_jax.losses.regularizers import (
    opacity_regularizer,
    photometry_regularizers,
    scale_regularizer,
)
from p2gs_jax.losses.relative_exposure import (
    ColorPairs,
    ExposurePairs,
    relative_exposure_loss,
)
from p2gs_jax.photometry.appearance import roughness
from p2gs_jax.photometry.formation import formation
from p2gs_jax.render import render_linear
from p2gs_jax.render.warp import sample_bilinear, surface_depth, warp
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Population, Render

# The readings of L_exp that compare renders from two poses.
SECOND_RENDER_FORMS = ("literal_pixels", "exposed")
OBSERVED_FORMS = ("observed_linear", "observed_ldr")
# A sample between masked pixels is masked.
ALL_UNMASKED = 0.999


class Partner(eqx.Module):
    """What the relative-exposure loss compares the training view with.

    Attributes:
        view_index: a second view, drawn at random.
        camera: its camera, for the readings that compare renders; same size as the training
            view's.
        batch: its photograph, for the readings that compare photographs through depth.
        pairs: track observations, for those that compare photographs at tracks.
    """

    view_index: Int[Array, ""]
    camera: Camera | None = None
    batch: Batch | None = None
    pairs: ColorPairs | None = None


class LossAux(NamedTuple):
    """What a step reports beside the loss.

    Attributes:
        terms: weighted terms by name.
        render: of the training view.
        ldr: its display image, unclamped.
        entries: tile-list entries that the larger of the renders needed.
        overflow: a tile list did not fit.
    """

    terms: dict[str, Float[Array, ""]]
    render: Render
    ldr: Float[Array, "h w 3"]
    entries: Int[Array, ""]
    overflow: Bool[Array, ""]


def depth_pairs(render: Render, batch: Batch, other: Render, other_batch: Batch) -> ColorPairs:
    """Return the photographed colours of every pixel and of where depth finds it in another view.

    Args:
        render: of the training view, with depth; no gradient flows through it.
        batch: its photograph.
        other: of the other view, with depth.
        other_batch: its photograph.
    """
    there = warp(surface_depth(render), batch.camera, surface_depth(other), other_batch.camera)
    both = jnp.concatenate([other_batch.ldr, other_batch.mask[..., None]], -1)
    seen = sample_bilinear(both, there.xy)
    valid = there.seen & (batch.mask > 0) & (seen[..., 3] > ALL_UNMASKED)
    count = batch.mask.size
    return lax.stop_gradient(
        ColorPairs(
            batch.ldr.reshape(-1, 3),
            seen[..., :3].reshape(-1, 3),
            jnp.full(count, batch.view_index),
            jnp.full(count, other_batch.view_index),
            valid.reshape(-1).astype(jnp.float32),
        )
    )


def total_loss(
    params: Params,
    means2d_probe: Float[Array, "n 2"] | None,
    population: Population,
    batch: Batch,
    partner: Partner,
    cfg: FitConfig,
    *,
    capacity: int,
    active_degree: Int[Array, ""],
    extent: float,
) -> tuple[Float[Array, ""], LossAux]:
    """Return the loss of one view and its terms.

    Args:
        params: Gaussians and photometry.
        means2d_probe: zeros whose gradient is the screen-space statistic, or None.
        population: who is alive.
        batch: the photograph.
        partner: the second view of the relative-exposure loss.
        cfg: weights; a weight of None keeps its term out of the trace.
        capacity: tile-list entries.
        active_degree: spherical-harmonics degree in use.
        extent: scene extent, scene units.
    """
    relative = cfg.loss.relative_exposure
    reads = None if relative.weight is None else relative.form
    through_depth = reads in OBSERVED_FORMS and partner.batch is not None

    def rendered(gaussians: Gaussians, camera: Camera, probe=None) -> Render:
        return render_linear(
            gaussians,
            population.alive,
            camera,
            cfg.render,
            capacity,
            active_degree=active_degree,
            means2d_probe=probe,
            with_depth=through_depth,
        )

    render = rendered(params.gaussians, batch.camera, means2d_probe)
    entries, overflow = render.count, render.overflow
    exposures, gammas = params.photometry.exposures, params.photometry.gammas
    i, j = batch.view_index, partner.view_index
    correction = params.correction(i)
    ldr = formation(render.linear, exposures[i], gammas[i], cfg.photometry, correction)
    terms = dict(photometric_loss(ldr, batch.ldr, batch.mask, cfg.loss))

    if relative.weight is not None:
        other, pairs = None, partner.pairs
        if reads in SECOND_RENDER_FORMS and partner.camera is not None:
            other = rendered(params.gaussians, partner.camera)
        elif through_depth:
            assert partner.batch is not None
            other = rendered(lax.stop_gradient(params.gaussians), partner.batch.camera)
            pairs = depth_pairs(render, batch, other, partner.batch)
        if other is not None:
            entries = jnp.maximum(entries, other.count)
            overflow = overflow | other.overflow
        linear_j = None if other is None else other.linear
        terms["relative_exposure"] = relative.weight * relative_exposure_loss(
            ExposurePairs(render.linear, linear_j, i, j, exposures, gammas, pairs),
            cfg.loss,
            cfg.photometry,
        )
    terms |= photometry_regularizers(params.photometry, cfg.loss.regularizers)
    smoothness = cfg.loss.regularizers.appearance
    if cfg.photometry.appearance == "bilateral" and smoothness is not None:
        assert params.appearance is not None
        terms["appearance"] = smoothness * roughness(params.appearance, "bilateral")
    if cfg.densify.method == "mcmc":
        reg = cfg.loss.regularizers
        if reg.opacity is not None:
            terms["opacity"] = reg.opacity * opacity_regularizer(params.gaussians, population.alive)
        if reg.scale is not None:
            terms["scale"] = reg.scale * scale_regularizer(
                params.gaussians, population.alive, extent
            )
    return jax.tree.reduce(jnp.add, terms), LossAux(terms, render, ldr, entries, overflow)
