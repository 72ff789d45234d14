"""Relative exposure consistency: L_exp and its readings (paper, eq. 9; docs/photometry.md, 3).

Printed: L_exp = (1/M) sum |alpha_ij L_i - L_j|_1 with alpha_ij = e_j / e_i and L free of exposure.
At the truth L_i = L_j for the same surface, so the printed formula is zero only where all
exposures are equal; each reading below is one way of making sense of it. Where white balance and
vignetting are modelled, e W V stands for e.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from p2gs_jax.config import LossConfig, PhotometryConfig
from p2gs_jax.photometry.formation import expose, gain, inverse_formation, tone_map
from p2gs_jax.types import Photometry


class ColorPairs(eqx.Module):
    """Photographed colours of the same surface points in two training views.

    Attributes:
        colors_i: display-encoded colours in the first view.
        colors_j: and in the second.
        views_i: rows in `Photometry`.
        views_j: likewise.
        valid: 1 = use.
        positions_i: where in the first view's image, from its centre in units of half its
            diagonal; None where nothing depends on it.
        positions_j: likewise in the second.
    """

    colors_i: Float[Array, "m 3"]
    colors_j: Float[Array, "m 3"]
    views_i: Int[Array, " m"]
    views_j: Int[Array, " m"]
    valid: Float[Array, " m"]
    positions_i: Float[Array, "m 2"] | None = None
    positions_j: Float[Array, "m 2"] | None = None


# Where less than this share of the pairs is valid, the mean is taken as if that many were.
FEWEST_VALID = 0.01


class ExposurePairs(eqx.Module):
    """What the readings need.

    Attributes:
        linear_i: render of view i, linear.
        linear_j: render of view j, for `literal_pixels`.
        view_i: row of view i.
        view_j: row of view j.
        photometry: what every view did to light.
        pairs: corresponding observations, for `observed_ldr`.
    """

    linear_i: Float[Array, "h w 3"]
    linear_j: Float[Array, "h w 3"] | None
    view_i: Int[Array, ""]
    view_j: Int[Array, ""]
    photometry: Photometry
    pairs: ColorPairs | None


def _per_pixel_l1(difference: Float[Array, "... 3"]) -> Float[Array, ""]:
    """Return (1/M) times the L1 norm over pixels and channels, M the number of pixels."""
    return jnp.mean(jnp.sum(jnp.abs(difference), -1))


def literal_same_pose(linear_i, e_i, e_j) -> Float[Array, ""]:
    """Both radiances at one pose: |e_j/e_i - 1| L. Zero iff the exposures are equal."""
    return _per_pixel_l1((e_j / e_i - 1) * linear_i)


def literal_pixels(linear_i, linear_j, e_i, e_j) -> Float[Array, ""]:
    """Renders of two poses, pixel by pixel: compares unrelated surface points."""
    return _per_pixel_l1(e_j / e_i * linear_i - linear_j)


def usable(colors: Float[Array, "m 3"], cfg: LossConfig) -> Float[Array, "m 3"]:
    """Return 1 where a photographed value is neither near black nor saturated."""
    return ((colors > cfg.black) & (colors < cfg.saturation)).astype(colors.dtype)


def _exposed_alike(pairs: ColorPairs, photometry: Photometry, cfg: PhotometryConfig):
    """Return what the first photograph's surfaces are in the second's exposure, and its capture."""
    capture_i, capture_j = photometry.capture(pairs.views_i), photometry.capture(pairs.views_j)
    radiance = inverse_formation(pairs.colors_i, capture_i, cfg, pairs.positions_i)
    return expose(radiance, capture_j, cfg, pairs.positions_j), capture_j


def _mean_over_pairs(
    error: Float[Array, "m 3"], pairs: ColorPairs, cfg: LossConfig
) -> Float[Array, ""]:
    """Return the mean over valid pairs; values near black or saturated count as zero."""
    weight = usable(pairs.colors_i, cfg) * usable(pairs.colors_j, cfg) * pairs.valid[:, None]
    fewest = FEWEST_VALID * pairs.valid.size
    return jnp.sum(weight * error) / jnp.maximum(jnp.sum(pairs.valid), fewest)


def huber(x: Float[Array, "..."], delta: float) -> Float[Array, "..."]:
    """Return the Huber loss with slope 1 in its tails."""
    a = jnp.abs(x)
    return jnp.where(a < delta, 0.5 * a * a / delta, a - 0.5 * delta)


def observed_ldr(
    pairs: ColorPairs, photometry: Photometry, loss: LossConfig, cfg: PhotometryConfig
) -> Float[Array, ""]:
    """Huber(T_j(alpha T_i^-1(I_i(u))) - I_j(w(u))): PIR in display units, scale-invariant."""
    predicted, capture_j = _exposed_alike(pairs, photometry, cfg)
    shown = tone_map(predicted, capture_j.gamma[:, None], cfg, capture_j.camera)
    error = huber(shown - pairs.colors_j, loss.relative_exposure.huber_delta)
    return _mean_over_pairs(error, pairs, loss)


def relative_exposure_loss(
    given: ExposurePairs, cfg: LossConfig, photometry: PhotometryConfig
) -> Float[Array, ""]:
    """Return the configured reading, unweighted.

    Raises:
        ValueError: the reading needs a second render or observations that were not given, or
            renders of one size.
    """
    form = cfg.relative_exposure.form
    if form == "observed_ldr":
        if given.pairs is None:
            raise ValueError(f"the reading {form!r} needs corresponding observations")
        return observed_ldr(given.pairs, given.photometry, cfg, photometry)
    shape = given.linear_i.shape
    e_i, e_j = (
        gain(shape, given.photometry.capture(row), photometry)
        for row in (given.view_i, given.view_j)
    )
    if form == "literal_same_pose":
        return literal_same_pose(given.linear_i, e_i, e_j)
    if given.linear_j is None:
        raise ValueError(f"the reading {form!r} needs the render of a second view")
    if given.linear_j.shape != shape:
        sizes = f"{shape} and {given.linear_j.shape}"
        raise ValueError(f"the reading {form!r} subtracts renders of one size, not {sizes}")
    return literal_pixels(given.linear_i, given.linear_j, e_i, e_j)
