"""Relative exposure consistency: two forms of the loss L_exp (paper, eq. 9; docs/photometry.md, 3).

Printed: L_exp = (1/M) sum |alpha_ij L_i - L_j|_1 with alpha_ij = e_j / e_i and L without exposure.
For true values L_i = L_j on the same surface, so the printed formula is zero only if all exposures
are equal. The two forms below are possible interpretations. If white balance and vignetting are
modelled, e W V replaces e.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int

from p2gs_jax.config import FitConfig, LossConfig, PhotometryConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.formation import darkens, gain, inverse_formation, tone_map
from p2gs_jax.photometry.observations import Observations, sample_pairs
from p2gs_jax.types import Array, Photometry

# Number of pairs from which the steps of a fit draw.
PAIR_POOL = 200_000


class ColorPairs(eqx.Module):
    """Photographed colours of the same surface points in two training views."""

    colors_i: Float[Array, "m 3"]  # display-encoded colours in the first view
    colors_j: Float[Array, "m 3"]  # display-encoded colours in the second view
    views_i: Int[Array, " m"]  # rows of the first views in `Photometry`
    views_j: Int[Array, " m"]  # rows of the second views in `Photometry`
    # positions in the first view's image, from its centre in units of half its diagonal; None if
    # vignetting is not modelled
    positions_i: Float[Array, "m 2"] | None = None
    positions_j: Float[Array, "m 2"] | None = None  # positions in the second view's image


class Partner(eqx.Module):
    """The second view and the pairs of a step, for the relative-exposure loss."""

    view_index: Int[Array, ""]  # row of a second view, drawn at random
    pairs: ColorPairs | None = None  # track observations, for the form `observed_ldr`


def literal_same_pose(linear: Float[Array, "h w 3"], e_i, e_j) -> Float[Array, ""]:
    """Return the loss if L_i and L_j are the same render L: |e_j/e_i - 1| L.

    It averages pixels, sums channels, and is zero iff the exposures are equal or L is black.
    """
    return jnp.mean(jnp.sum(jnp.abs((e_j / e_i - 1) * linear), -1))


def usable(colors: Float[Array, "m 3"], cfg: LossConfig) -> Float[Array, "m 3"]:
    """Return 1 for photographed values that are neither near black nor saturated, else 0."""
    return ((colors > cfg.black) & (colors < cfg.saturation)).astype(colors.dtype)


def observed_ldr(
    pairs: ColorPairs, photometry: Photometry, loss: LossConfig, cfg: PhotometryConfig
) -> Float[Array, ""]:
    """Return the mean of Huber(T_j(alpha T_i^-1(I_i(u))) - I_j(w(u))) over pairs.

    One point is at u and at w(u). This is the principle of invariant radiance in display units, and
    scale-invariant. The error of values that are near black or saturated counts as zero. The Huber
    loss has slope 1 in its tails.
    """
    capture_i, capture_j = photometry.capture(pairs.views_i), photometry.capture(pairs.views_j)
    radiance = inverse_formation(pairs.colors_i, capture_i, cfg, pairs.positions_i)
    predicted = gain(radiance.shape, capture_j, cfg, pairs.positions_j) * radiance
    display = tone_map(predicted, capture_j.gamma[:, None], cfg, capture_j.camera)
    delta = loss.relative_exposure.huber_delta
    error = optax.huber_loss(display, pairs.colors_j, delta=delta) / delta
    weight = usable(pairs.colors_i, loss) * usable(pairs.colors_j, loss)
    return jnp.sum(weight * error) / len(weight)


def relative_exposure_loss(
    linear: Float[Array, "h w 3"],
    views: tuple[Int[Array, ""], Int[Array, ""]],
    pairs: ColorPairs | None,
    photometry: Photometry,
    loss: LossConfig,
    cfg: PhotometryConfig,
) -> Float[Array, ""]:
    """Return the configured form of the loss, unweighted.

    `linear` is the render of the first of the `views`; `pairs` are colours of the same points in
    two views, for the form `observed_ldr`. Raises ValueError: the form needs `pairs`, which are
    None.
    """
    if loss.relative_exposure.form == "observed_ldr":
        if pairs is None:
            raise ValueError("the form 'observed_ldr' needs pairs of colours")
        return observed_ldr(pairs, photometry, loss, cfg)
    e_i, e_j = (gain(linear.shape, photometry.capture(row), cfg) for row in views)
    return literal_same_pose(linear, e_i, e_j)


def color_pairs(tracks: Observations | None, cfg: FitConfig) -> ColorPairs | None:
    """Return pairs of colours of one point in two views; None if the loss uses none.

    Raises UserError: the loss needs pairs, and the scene has no tracks.
    """
    relative = cfg.loss.relative_exposure
    if relative.weight is None or relative.form != "observed_ldr":
        return None
    if tracks is None or not len(tracks.points):
        why = "the relative-exposure loss compares photographs at tracks, and this scene has none."
        fix = "use --loss.relative-exposure.form literal_same_pose, or a scene with tracks"
        raise UserError(why, fix=fix)
    first, second = sample_pairs(tracks, PAIR_POOL, cfg.train.seed)
    places = ()
    if darkens(cfg.photometry):
        if tracks.positions is None:
            raise ValueError("vignetting is modelled, and positions in the images are not known")
        places = (tracks.positions[first], tracks.positions[second])
    return ColorPairs(
        on_device(tracks.colors[first]),
        on_device(tracks.colors[second]),
        on_device(tracks.views[first], np.int32),
        on_device(tracks.views[second], np.int32),
        *map(on_device, places),
    )
