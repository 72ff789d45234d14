"""The image's side of a step: which Gaussians a view may show, and the gradient of its loss."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import FitConfig, RenderConfig
from p2gs_jax.losses.total import Partner, decoded, image_loss
from p2gs_jax.photometry.appearance import Corrections
from p2gs_jax.render.harmonics import coefficient_count
from p2gs_jax.render.project import camera_of_each
from p2gs_jax.render.visible import Shown, compact, in_view, splat_listed, whole_blocks
from p2gs_jax.types import Batch, Frustum, Gaussians, Photometry


class Listed(NamedTuple):
    """What a step shows.

    Attributes:
        ids: of the Gaussians that the views may show, from `compact`.
        visible: how many there are.
        shown: splats and radiance of the listed ones in each view.
    """

    ids: Int[Array, " v"]
    visible: Int[Array, ""]
    shown: tuple[Shown, ...]


class ImageGradient(NamedTuple):
    """The loss of the images and its gradients.

    Attributes:
        loss: sum of the terms.
        terms: by name, weighted.
        v_shown: gradient by what `differentiable` takes of the splats.
        v_rest: by photometry and appearance.
        entries: tile-list entries that were needed.
        overflow: they did not fit.
        visible: which of the listed Gaussians are in the training view.
        psnr: of the view, dB.
    """

    loss: Float[Array, ""]
    terms: dict[str, Float[Array, ""]]
    v_shown: Any
    v_rest: Any
    entries: Int[Array, ""]
    overflow: Bool[Array, ""]
    visible: Bool[Array, " v"]
    psnr: Float[Array, ""]


def show(
    gaussians: Gaussians,
    alive: Bool[Array, " n"],
    frusta: tuple[Frustum, ...],
    active_degree: Int[Array, ""],
    owner: Int[Array, " n"] | None = None,
    *,
    cfg: RenderConfig,
    visible_only: bool,
    room: int,
    degree: int,
) -> Listed:
    """List what the views of a step may show, and project it.

    Args:
        gaussians: the scene.
        alive: slots in use.
        frusta: the views.
        active_degree: spherical-harmonics degree in use.
        owner: the moving object that each Gaussian belongs to, or None.
        cfg: rendering options.
        visible_only: leave out what no view may show (`OptimizerConfig.visible_only`).
        room: length of the list; what finds no place is counted, not listed.
        degree: highest spherical-harmonics degree that is evaluated.
    """
    n = gaussians.capacity
    if visible_only:
        views = (camera_of_each(f, owner) for f in frusta)
        may = functools.reduce(jnp.logical_or, (in_view(gaussians, alive, v, cfg) for v in views))
        ids, count = compact(may, whole_blocks(min(room, n)))
    else:
        index = jnp.arange(whole_blocks(n), dtype=jnp.int32)
        ids, count = jnp.minimum(index, n), jnp.int32(n)
    bands = coefficient_count(degree)
    shown = splat_listed(gaussians, alive, ids, count, frusta, cfg, active_degree, bands, owner)
    return Listed(ids, count, shown)


def differentiate(
    shown: tuple[Shown, ...],
    photometry: Photometry,
    appearance: Corrections | None,
    batch: Batch,
    partner: Partner,
    *,
    cfg: FitConfig,
    room: int,
) -> ImageGradient:
    """Composite a view, compare it with its photograph and return the gradient of the loss.

    Args:
        shown: from `show`.
        photometry: of all views.
        appearance: corrections of all views, or None.
        batch: the view and its photograph.
        partner: the second view, as the loss needs it.
        cfg: rendering, loss and formation model.
        room: length of the tile lists.
    """
    (loss, aux), (v_shown, *v_rest) = jax.value_and_grad(
        image_loss, argnums=(0, 1, 2), has_aux=True, allow_int=True
    )(shown, photometry, appearance, batch, partner, cfg, room)
    photograph, mask = decoded(batch)
    squared = mask[..., None] * (jnp.clip(aux.ldr, 0, 1) - photograph) ** 2
    mse = jnp.sum(squared) / jnp.maximum(3 * jnp.sum(mask), 1)
    return ImageGradient(
        loss,
        aux.terms,
        differentiable(v_shown),
        tuple(v_rest),
        aux.entries,
        aux.overflow,
        aux.render.visible,
        -10 * jnp.log10(jnp.maximum(mse, 1e-10)),
    )


def differentiable(shown: tuple[Shown, ...]) -> tuple[tuple[Array, ...], ...]:
    """Return what the image is made of, without flags and what only bins."""
    return tuple(
        (s.means2d, s.conic_factor, s.log_opacities, s.depths, radiance) for s, radiance in shown
    )
