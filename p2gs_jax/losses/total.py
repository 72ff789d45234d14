"""The composed loss (paper, eq. 7): one differentiable function of the one parameter pytree."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.losses.image import photometric_loss
from p2gs_jax.losses.lidar import lidar_loss
from p2gs_jax.losses.luminance import luminance_terms
from p2gs_jax.losses.matte import matted_loss, unit
from p2gs_jax.losses.regularizers import photometry_regularizers
from p2gs_jax.losses.relative_exposure import ColorPairs, ExposurePairs, relative_exposure_loss
from p2gs_jax.photometry.appearance import Corrections, correction_of, regularisation
from p2gs_jax.photometry.formation import formation
from p2gs_jax.photometry.luminance import Curves
from p2gs_jax.render import render_splats
from p2gs_jax.render.visible import Shown, splat
from p2gs_jax.types import Batch, Camera, Params, Photometry, Render

# The readings of L_exp that compare renders from two poses.
SECOND_RENDER_FORMS = ("literal_pixels",)


class Partner(eqx.Module):
    """What the relative-exposure loss compares the training view with.

    Attributes:
        view_index: a second view, drawn at random.
        camera: its camera, for the reading that compares renders; same size as the training
            view's.
        pairs: track observations, for the one that compares photographs at tracks.
    """

    view_index: Int[Array, ""]
    camera: Camera | None = None
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


def decoded(batch: Batch) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]:
    """Return a photograph in [0, 1] and its mask as floats; they travel as they are stored.

    One with alpha is put over its backdrop. Their precision is the camera's.
    """
    kind = batch.camera.K.dtype
    ldr = batch.ldr.astype(kind)
    scale = float(np.iinfo(batch.ldr.dtype).max) if batch.ldr.dtype.kind == "u" else 1.0
    ldr = ldr / scale
    if batch.alpha is not None and batch.backdrop is not None:
        ldr = ldr + (1 - unit(batch.alpha)[..., None]) * batch.backdrop
    return ldr, batch.mask.astype(kind)


def partner_cameras(partner: Partner, cfg: FitConfig) -> tuple[Camera, ...]:
    """Return the camera of the second render that the loss needs, if it needs one."""
    relative = cfg.loss.relative_exposure
    if relative.weight is None:
        return ()
    if relative.form in SECOND_RENDER_FORMS and partner.camera is not None:
        return (partner.camera,)
    return ()


def image_loss(
    shown: tuple[Shown, ...],
    photometry: Photometry,
    appearance: Corrections | None,
    batch: Batch,
    partner: Partner,
    cfg: FitConfig,
    capacity: int,
) -> tuple[Float[Array, ""], LossAux]:
    """Return the loss of one view and its terms.

    Args:
        shown: splats and radiance in the view and in each of `partner_cameras`.
        photometry: exposures and gammas.
        appearance: corrections of display values, or None.
        batch: the photograph.
        partner: the second view of the relative-exposure loss.
        cfg: weights; a weight of None keeps its term out of the trace.
        capacity: tile-list entries.
    """
    relative = cfg.loss.relative_exposure
    cameras = (batch.camera, *partner_cameras(partner, cfg))
    renders = []
    measured, lidar_weight = batch.measured, cfg.loss.lidar
    compares_depth = measured is not None and lidar_weight is not None
    for (splats, radiance), camera in zip(shown, cameras, strict=True):
        deep = compares_depth and not renders
        renders.append(
            render_splats(splats, radiance, camera, cfg.render, capacity, with_depth=deep)
        )
    render, *others = renders
    entries, overflow = render.count, render.overflow
    i, j = batch.view_index, partner.view_index
    correction = correction_of(appearance, i)
    if batch.alpha is None:
        photograph, mask = decoded(batch)
        ldr = formation(render.linear, photometry.capture(i), cfg.photometry, correction)
        terms = dict(photometric_loss(ldr, photograph, mask, cfg.loss))
        if isinstance(correction, Curves):
            light = formation(render.linear, photometry.capture(i), cfg.photometry)
            terms |= luminance_terms(light, photograph, mask, correction, cfg.loss)
    else:
        ldr, terms = matted_loss(render, batch, photometry.capture(i), correction, cfg)
    if measured is not None and lidar_weight is not None:
        terms["lidar"] = lidar_weight * lidar_loss(render, measured)

    if relative.weight is not None:
        other, pairs = next(iter(others), None), partner.pairs
        if other is not None:
            entries = jnp.maximum(entries, other.count)
            overflow = overflow | other.overflow
        linear_j = None if other is None else other.linear
        terms["relative_exposure"] = relative.weight * relative_exposure_loss(
            ExposurePairs(render.linear, linear_j, i, j, photometry, pairs),
            cfg.loss,
            cfg.photometry,
        )
    terms |= photometry_regularizers(photometry, cfg.loss.regularizers)
    kind, weight = cfg.photometry.appearance, cfg.loss.regularizers.appearance
    if kind is not None and weight is not None:
        assert appearance is not None
        asked = regularisation(appearance, kind)
        terms |= {} if asked is None else {"appearance": weight * asked}
    return jax.tree.reduce(jnp.add, terms), LossAux(terms, render, ldr, entries, overflow)


def total_loss(
    params: Params,
    alive: Bool[Array, " n"],
    batch: Batch,
    partner: Partner,
    cfg: FitConfig,
    *,
    capacity: int,
    active_degree: Int[Array, ""] | int,
    owner: Int[Array, " n"] | None = None,
) -> tuple[Float[Array, ""], LossAux]:
    """Return the loss of one view and its terms, as one function of the parameters.

    The step computes the same in blocks (train/step.py).

    Args:
        params: Gaussians and photometry.
        alive: slots in use.
        batch: the photograph.
        partner: the second view of the relative-exposure loss.
        cfg: weights; a weight of None keeps its term out of the trace.
        capacity: tile-list entries.
        active_degree: spherical-harmonics degree in use.
        owner: the moving object that each Gaussian belongs to, or None.
    """
    cameras = (batch.camera, *partner_cameras(partner, cfg))
    shown = splat(params.gaussians, alive, cameras, cfg.render, active_degree, owner)
    return image_loss(shown, params.photometry, params.appearance, batch, partner, cfg, capacity)
