"""The composed loss (paper, eq. 7): one differentiable function of the one parameter pytree."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.losses.image import photometric_loss
from p2gs_jax.losses.lidar import lidar_loss
from p2gs_jax.losses.luminance import luminance_terms
from p2gs_jax.losses.matte import matted_loss, unit
from p2gs_jax.losses.regularizers import photometry_regularizers, population_terms, pose_terms
from p2gs_jax.losses.relative_exposure import ColorPairs, ExposurePairs, relative_exposure_loss
from p2gs_jax.photometry.appearance import Corrections, correction_of, regularisation
from p2gs_jax.photometry.cameras import places
from p2gs_jax.photometry.formation import darkens, formation
from p2gs_jax.photometry.luminance.parameters import Curves
from p2gs_jax.render import render_splats
from p2gs_jax.render.objects import with_corrections
from p2gs_jax.render.visible import Shown, splat
from p2gs_jax.render.warp import sample_bilinear, surface_depth, warp
from p2gs_jax.types import Batch, Camera, Params, Photometry, Render

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


def _there(batch: Batch, mask: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Return a mask without the pixels that a background shows through."""
    if batch.alpha is None:
        return mask
    return jnp.where(unit(batch.alpha) > ALL_UNMASKED, mask, 0.0)


def depth_pairs(
    render: Render, batch: Batch, other: Render, other_batch: Batch, placed: bool = False
) -> ColorPairs:
    """Return the photographed colours of every pixel and of where depth finds it in another view.

    Args:
        render: of the training view, with depth; no gradient flows through it.
        batch: its photograph.
        other: of the other view, with depth.
        other_batch: its photograph.
        placed: say where in their images the colours are, as vignetting needs.
    """
    there = warp(surface_depth(render), batch.camera, surface_depth(other), other_batch.camera)
    (ldr, mask), (other_ldr, other_mask) = decoded(batch), decoded(other_batch)
    mask, other_mask = _there(batch, mask), _there(other_batch, other_mask)
    both = jnp.concatenate([other_ldr, other_mask[..., None]], -1)
    seen = sample_bilinear(both, there.xy)
    valid = there.seen & (mask > 0) & (seen[..., 3] > ALL_UNMASKED)
    count = mask.size
    positions = ()
    if placed:
        here = jnp.stack(jnp.meshgrid(*map(jnp.arange, mask.shape[::-1])), -1) + 0.5
        positions = tuple(
            places(xy.reshape(-1, 2), c.width, c.height)
            for xy, c in ((here, batch.camera), (there.xy, other_batch.camera))
        )
    return lax.stop_gradient(
        ColorPairs(
            ldr.reshape(-1, 3),
            seen[..., :3].reshape(-1, 3),
            jnp.full(count, batch.view_index),
            jnp.full(count, other_batch.view_index),
            valid.reshape(-1).astype(jnp.float32),
            *positions,
        )
    )


def partner_cameras(partner: Partner, cfg: FitConfig) -> tuple[Camera, ...]:
    """Return the camera of the second render that the loss needs, if it needs one."""
    relative = cfg.loss.relative_exposure
    if relative.weight is None:
        return ()
    if relative.form in SECOND_RENDER_FORMS and partner.camera is not None:
        return (partner.camera,)
    if relative.form in OBSERVED_FORMS and partner.batch is not None:
        return (partner.batch.camera,)
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
    """Return the loss of one view and its terms, but for those on the Gaussians themselves.

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
    through_depth = relative.form in OBSERVED_FORMS and partner.batch is not None
    through_depth = through_depth and relative.weight is not None
    cameras = (batch.camera, *partner_cameras(partner, cfg))
    renders = []
    measured, lidar_weight = batch.measured, cfg.loss.lidar
    compares_depth = measured is not None and lidar_weight is not None
    for (splats, radiance), camera in zip(shown, cameras, strict=True):
        if renders and through_depth:
            splats, radiance = lax.stop_gradient((splats, radiance))
        deep = through_depth or (compares_depth and not renders)
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
        if through_depth and other is not None and partner.batch is not None:
            pairs = depth_pairs(render, batch, other, partner.batch, darkens(cfg.photometry))
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
    extent: float,
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
        extent: scene extent, scene units.
        owner: the moving object that each Gaussian belongs to, or None.
    """
    cameras = (batch.camera, *partner_cameras(partner, cfg))
    cameras = with_corrections(cameras, params.poses)
    shown = splat(params.gaussians, alive, cameras, cfg.render, active_degree, owner)
    loss, aux = image_loss(
        shown, params.photometry, params.appearance, batch, partner, cfg, capacity
    )
    own = population_terms(params.gaussians, alive, cfg, extent)
    own |= pose_terms(params.poses, batch.camera.objects, cfg.loss.regularizers)
    total = jax.tree.reduce(jnp.add, own, loss)
    return total, aux._replace(terms=aux.terms | own)
