"""Relative exposure consistency: L_exp and its readings (paper, eq. 9; docs/photometry.md, 3).

Printed: L_exp = (1/M) sum |alpha_ij L_i - L_j|_1 with alpha_ij = e_j / e_i and L free of exposure.
At the truth L_i = L_j for the same surface, so the printed formula is zero only where all
exposures are equal; both readings below are ways of making sense of it. Where white balance and
vignetting are modelled, e W V stands for e.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import FitConfig, LossConfig, PhotometryConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.formation import darkens, gain, inverse_formation, tone_map
from p2gs_jax.photometry.observations import Observations, sample_pairs
from p2gs_jax.types import Array, Photometry

# Where less than this share of the pairs is valid, the mean is taken as if that many were.
FEWEST_VALID = 0.01
# Pairs that the steps of a fit draw from.
PAIR_POOL = 200_000


class ColorPairs(eqx.Module):
    """Photographed colours of the same surface points in two training views."""

    colors_i: Float[Array, "m 3"]  # display-encoded colours in the first view
    colors_j: Float[Array, "m 3"]  # and in the second
    views_i: Int[Array, " m"]  # rows in `Photometry`
    views_j: Int[Array, " m"]  # likewise
    valid: Float[Array, " m"]  # 1 = use
    # where in the first view's image, from its centre in units of half its diagonal; None where
    # nothing depends on it
    positions_i: Float[Array, "m 2"] | None = None
    positions_j: Float[Array, "m 2"] | None = None  # likewise in the second


class Partner(eqx.Module):
    """What the relative-exposure loss compares the training view with."""

    view_index: Int[Array, ""]  # a second view, drawn at random
    pairs: ColorPairs | None = None  # track observations, for the reading that compares photographs


def literal_same_pose(linear: Float[Array, "h w 3"], e_i, e_j) -> Float[Array, ""]:
    """Both radiances at one pose: |e_j/e_i - 1| L, the mean over pixels of the sum over channels.

    Zero iff the exposures are equal.
    """
    return jnp.mean(jnp.sum(jnp.abs((e_j / e_i - 1) * linear), -1))


def usable(colors: Float[Array, "m 3"], cfg: LossConfig) -> Float[Array, "m 3"]:
    """Return 1 where a photographed value is neither near black nor saturated."""
    return ((colors > cfg.black) & (colors < cfg.saturation)).astype(colors.dtype)


def huber(x: Float[Array, "..."], delta: float) -> Float[Array, "..."]:
    """Return the Huber loss with slope 1 in its tails."""
    a = jnp.abs(x)
    return jnp.where(a < delta, 0.5 * a * a / delta, a - 0.5 * delta)


def observed_ldr(
    pairs: ColorPairs, photometry: Photometry, loss: LossConfig, cfg: PhotometryConfig
) -> Float[Array, ""]:
    """Huber(T_j(alpha T_i^-1(I_i(u))) - I_j(w(u))): PIR in display units, scale-invariant.

    The mean is over valid pairs; values near black or saturated count as zero.
    """
    capture_i, capture_j = photometry.capture(pairs.views_i), photometry.capture(pairs.views_j)
    radiance = inverse_formation(pairs.colors_i, capture_i, cfg, pairs.positions_i)
    predicted = gain(radiance.shape, capture_j, cfg, pairs.positions_j) * radiance
    shown = tone_map(predicted, capture_j.gamma[:, None], cfg, capture_j.camera)
    error = huber(shown - pairs.colors_j, loss.relative_exposure.huber_delta)
    weight = usable(pairs.colors_i, loss) * usable(pairs.colors_j, loss) * pairs.valid[:, None]
    fewest = FEWEST_VALID * pairs.valid.size
    return jnp.sum(weight * error) / jnp.maximum(jnp.sum(pairs.valid), fewest)


def relative_exposure_loss(
    linear: Float[Array, "h w 3"],
    views: tuple[Int[Array, ""], Int[Array, ""]],
    pairs: ColorPairs | None,
    photometry: Photometry,
    loss: LossConfig,
    cfg: PhotometryConfig,
) -> Float[Array, ""]:
    """Return the configured reading, unweighted.

    `linear` is the render of the first of the `views`; `pairs` are corresponding observations, for
    `observed_ldr`.

    Raises:
        ValueError: the reading needs observations that were not given.
    """
    if loss.relative_exposure.form == "observed_ldr":
        if pairs is None:
            raise ValueError("the reading 'observed_ldr' needs corresponding observations")
        return observed_ldr(pairs, photometry, loss, cfg)
    e_i, e_j = (gain(linear.shape, photometry.capture(row), cfg) for row in views)
    return literal_same_pose(linear, e_i, e_j)


def color_pairs(tracks: Observations | None, cfg: FitConfig) -> ColorPairs | None:
    """Return pairs of colours of one point in two views; None where the loss uses none.

    Raises:
        UserError: the loss wants them and the scene has no tracks.
    """
    relative = cfg.loss.relative_exposure
    if relative.weight is None or relative.form != "observed_ldr":
        return None
    if tracks is None or not len(tracks.points):
        why = "the relative-exposure loss was to compare photographs at tracks, and this scene has "
        why += "none."
        fix = "use --loss.relative-exposure.form literal_same_pose, or a scene with tracks"
        raise UserError(why, fix=fix)
    first, second = sample_pairs(tracks, PAIR_POOL, cfg.train.seed)
    places = ()
    if darkens(cfg.photometry):
        if tracks.positions is None:
            raise ValueError("vignetting is modelled, and no places in the images are known")
        places = (tracks.positions[first], tracks.positions[second])
    return ColorPairs(
        on_device(tracks.colors[first]),
        on_device(tracks.colors[second]),
        on_device(tracks.views[first], np.int32),
        on_device(tracks.views[second], np.int32),
        on_device(np.ones(len(first))),
        *map(on_device, places),
    )
