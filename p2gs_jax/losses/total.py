"""The composed loss (paper, eq. 5): one differentiable function of the one parameter pytree."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.losses.image import photometric_loss
from p2gs_jax.losses.regularizers import (
    opacity_regularizer,
    photometry_regularizers,
    scale_regularizer,
)
from p2gs_jax.losses.relative_exposure import ExposurePairs, relative_exposure_loss
from p2gs_jax.photometry.formation import formation
from p2gs_jax.render import render_linear
from p2gs_jax.types import Batch, Camera, Params, Population, Render

# The readings of L_exp that compare renders from two poses.
SECOND_RENDER_FORMS = ("literal_pixels", "exposed")
OBSERVED_FORMS = ("observed_linear", "observed_ldr")


class TrackPairs(eqx.Module):
    """Colours of the same surface point in two training views, sampled from the tracks.

    Attributes:
        colors_i: display-encoded colours in the first view.
        colors_j: and in the second.
        views_i: rows in `Photometry`.
        views_j: likewise.
    """

    colors_i: Float[Array, "m 3"]
    colors_j: Float[Array, "m 3"]
    views_i: Int[Array, " m"]
    views_j: Int[Array, " m"]


class Partner(eqx.Module):
    """What the relative-exposure loss compares the training view with.

    Attributes:
        view_index: a second view, drawn at random.
        camera: its camera, for the readings that render it; same size as the training view's.
        pairs: corresponding observations, for the readings that use photographs.
    """

    view_index: Int[Array, ""]
    camera: Camera | None = None
    pairs: TrackPairs | None = None


class LossAux(NamedTuple):
    """What a step reports beside the loss."""

    terms: dict[str, Float[Array, ""]]
    render: Render
    ldr: Float[Array, "h w 3"]


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
    render = render_linear(
        params.gaussians,
        population.alive,
        batch.camera,
        cfg.render,
        capacity,
        active_degree=active_degree,
        means2d_probe=means2d_probe,
        with_depth=False,
    )
    exposures, gammas = params.photometry.exposures, params.photometry.gammas
    i, j = batch.view_index, partner.view_index
    ldr = formation(render.linear, exposures[i], gammas[i], cfg.photometry)
    terms = dict(photometric_loss(ldr, batch.ldr, batch.mask, cfg.loss))

    relative = cfg.loss.relative_exposure
    if relative.weight is not None:
        linear_j = None
        if relative.form in SECOND_RENDER_FORMS and partner.camera is not None:
            linear_j = render_linear(
                params.gaussians,
                population.alive,
                partner.camera,
                cfg.render,
                capacity,
                active_degree=active_degree,
                with_depth=False,
            ).linear
        terms["relative_exposure"] = relative.weight * relative_exposure_loss(
            ExposurePairs(render.linear, linear_j, i, j, exposures, gammas, partner.pairs),
            cfg.loss,
            cfg.photometry,
        )
    terms |= photometry_regularizers(params.photometry, cfg.loss.regularizers)
    if cfg.densify.method == "mcmc":
        reg = cfg.loss.regularizers
        if reg.opacity is not None:
            terms["opacity"] = reg.opacity * opacity_regularizer(params.gaussians, population.alive)
        if reg.scale is not None:
            terms["scale"] = reg.scale * scale_regularizer(
                params.gaussians, population.alive, extent
            )
    return jax.tree.reduce(jnp.add, terms), LossAux(terms, render, ldr)
