"""The image part of a step: the Gaussians that a view may show, and the gradient of its loss."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.evaluation.scores import psnr
from p2gs_jax.photometry.appearance import Correction, Corrections, correction_of
from p2gs_jax.photometry.formation import Matte, composited, formation, uncovered
from p2gs_jax.photometry.luminance import Curves
from p2gs_jax.render import render_splats
from p2gs_jax.render.harmonics import coefficient_count
from p2gs_jax.render.project import camera_of_each
from p2gs_jax.render.visible import Shown, compact, in_view, splat_listed, whole_blocks
from p2gs_jax.train.exposure_loss import Partner
from p2gs_jax.train.terms import Aux, LossTerm, Rendered, Target, censor
from p2gs_jax.types import Array, Batch, Frustum, Gaussians, Photometry, Render

# Photographed colours of pixels with a lower alpha count as black.
LEAST_SEEN = 0.5 / 255


class Listed(NamedTuple):
    """The Gaussians that the view of a step may show."""

    ids: Int[Array, " v"]  # from `compact`
    visible: Int[Array, ""]  # their number; larger than the length of `ids` after an overflow
    shown: Shown  # splats and radiance of the listed Gaussians


class ImageGradient(NamedTuple):
    """The loss of a view and its gradients."""

    loss: Float[Array, ""]  # sum of the terms
    terms: dict[str, Float[Array, ""]]  # weighted terms by name
    v_shown: Any  # gradient by the arrays of `differentiable`
    v_rest: Any  # gradient by photometry and appearance
    entries: Int[Array, ""]  # tile-list entries needed
    overflow: Bool[Array, ""]  # whether the tile list was too short
    visible: Bool[Array, " v"]  # flags of the listed Gaussians that are in the view
    psnr: Float[Array, ""]  # of the view, dB


def show(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    frustum: Frustum,
    active_degree: Int[Array, ""],
    owner: Int[Array, " n"] | None = None,
    *,
    cfg: FitConfig,
    capacity: int,
    degree: int,
) -> Listed:
    """List the Gaussians that the view of a step may show, and project them.

    If `cfg.optimizer.visible_only` is off, all Gaussians are listed. Gaussians beyond the list's
    length `capacity` are counted, not listed. `degree` is the highest spherical-harmonics degree
    that is evaluated; `owner` is the moving object of each Gaussian.
    """
    n, render = gaussians.capacity, cfg.render
    if cfg.optimizer.visible_only:
        may = in_view(gaussians, alive, camera_of_each(frustum, owner), render)
        ids, count = compact(may, whole_blocks(min(capacity, n)))
    else:
        index = jnp.arange(whole_blocks(n), dtype=jnp.int32)
        ids, count = jnp.minimum(index, n), jnp.int32(n)
    bands = coefficient_count(degree)
    shown = splat_listed(gaussians, alive, ids, count, frustum, render, active_degree, bands, owner)
    return Listed(ids, count, shown)


def decoded(batch: Batch) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]:
    """Return a photograph in [0, 1] and its mask, converted from their stored types to floats.

    A photograph with alpha is composited over its backdrop. Both have the precision of the camera.
    """
    kind = batch.camera.K.dtype
    ldr = unit(batch.ldr, kind)
    if batch.alpha is not None and batch.backdrop is not None:
        ldr = ldr + (1 - unit(batch.alpha)[..., None]) * batch.backdrop
    return ldr, batch.mask.astype(kind)


def unit(stored: Array, kind: DTypeLike = jnp.float32) -> Float[Array, "..."]:
    """Return stored unsigned integers as floats in [0, 1]; floats keep their values."""
    scale = float(jnp.iinfo(stored.dtype).max) if stored.dtype.kind == "u" else 1.0
    return stored.astype(kind) / scale


def pixel_places(shape: tuple[int, ...], size: Float[Array, " 2"]) -> Float[Array, "h w 2"]:
    """Return the positions of the pixels of a canvas in the image in its upper left corner.

    `size` is the width and height of the image, pixels. Positions are as in `formation`: from the
    image centre, in units of half the diagonal.
    """
    y, x = (jnp.arange(n, dtype=size.dtype) + 0.5 for n in shape)
    return (2 * jnp.stack(jnp.meshgrid(x, y), -1) - size) / jnp.linalg.norm(size)


def compared(
    render: Render,
    batch: Batch,
    photometry: Photometry,
    correction: Correction | None,
    cfg: FitConfig,
) -> tuple[Rendered, Target]:
    """Return the render of a view and its photograph, as inputs of loss terms.

    A photograph with alpha and the render are composited over the same background. Values are
    censored before that, because a white background does not saturate a photograph.
    """
    capture = photometry.capture(batch.view_index)
    loss, formed = cfg.loss, cfg.photometry
    where = None if batch.size is None else pixel_places(render.alpha.shape, batch.size)
    alpha = None if batch.alpha is None else unit(batch.alpha)
    target = Target(*decoded(batch), alpha, batch.measured)
    matte, photographed = None, target.ldr
    if alpha is not None:
        assert batch.backdrop is not None
        matte = Matte(render.alpha, batch.backdrop)
        color = unit(batch.ldr) / jnp.maximum(alpha, LEAST_SEEN)[..., None]
        photographed = jnp.where(alpha[..., None] > LEAST_SEEN, color, 0.0)
    radiance = uncovered(render.linear, matte)
    display = formation(radiance, capture, formed, correction, where)
    judged = ldr = composited(display, matte)
    if loss.censored:
        judged = composited(censor(display, photographed, loss.saturation), matte)
    uncorrected = None
    if isinstance(correction, Curves):
        uncorrected = composited(formation(radiance, capture, formed, None, where), matte)
    rendered = Rendered(render.linear, render.alpha, render.depth, ldr, judged, uncorrected)
    return rendered, target


def image_loss(
    shown: Shown,
    photometry: Photometry,
    appearance: Corrections | None,
    batch: Batch,
    partner: Partner,
    cfg: FitConfig,
    terms: Mapping[str, LossTerm],
    capacity: int,
) -> tuple[Float[Array, ""], tuple[dict[str, Float[Array, ""]], Render, Float[Array, "h w 3"]]]:
    """Return the loss of one view, and its terms by name, render and unclamped display image.

    `shown` holds splats and radiance in the view; `photometry` and `appearance` belong to all
    views; `capacity` is the length of the tile list.
    """
    with_depth = any(getattr(term, "needs_depth", False) for term in terms.values())
    render = render_splats(*shown, batch.camera, cfg.render, capacity, with_depth=with_depth)
    correction = correction_of(appearance, batch.view_index)
    rendered, target = compared(render, batch, photometry, correction, cfg)
    aux = Aux(
        batch.view_index,
        photometry.capture(batch.view_index),
        photometry,
        appearance,
        correction,
        partner.view_index,
        partner.pairs,
    )
    found = {name: term(rendered, target, aux) for name, term in terms.items()}
    values = {name: value for name, value in found.items() if value is not None}
    return jax.tree.reduce(jnp.add, values), (values, render, rendered.ldr)


def differentiate(
    shown: Shown,
    photometry: Photometry,
    appearance: Corrections | None,
    batch: Batch,
    partner: Partner,
    *,
    cfg: FitConfig,
    terms: tuple[tuple[str, LossTerm], ...],
    capacity: int,
) -> ImageGradient:
    """Composite a view, compare it with its photograph and return the gradient of the loss.

    For the arguments see `image_loss`.
    """
    (loss, (values, render, ldr)), (v_shown, *v_rest) = jax.value_and_grad(
        image_loss, argnums=(0, 1, 2), has_aux=True, allow_int=True
    )(shown, photometry, appearance, batch, partner, cfg, dict(terms), capacity)
    photograph, mask = decoded(batch)
    return ImageGradient(
        loss,
        values,
        _without_floaters(differentiable(v_shown), shown[0].depths, cfg),
        tuple(v_rest),
        render.count,
        render.overflow,
        render.visible,
        psnr(jnp.clip(ldr, 0, 1), photograph, mask),
    )


def _without_floaters(
    v_shown: tuple[Array, ...], depths: Float[Array, " v"], cfg: FitConfig
) -> tuple[Array, ...]:
    """Scale the gradients of near Gaussians down (`LossConfig.near_depth`)."""
    near = cfg.loss.near_depth
    if not near:
        return v_shown
    share = jnp.clip(depths / near, 0, 1) ** 2
    return tuple(v * share.reshape(-1, *[1] * (v.ndim - 1)) for v in v_shown)


def differentiable(shown: Shown) -> tuple[Array, ...]:
    """Return the arrays by which the image is differentiable, without the inputs of binning."""
    splats, radiance = shown
    return splats.means2d, splats.conic_factor, splats.log_opacities, splats.depths, radiance
