"""The composed loss (paper, eq. 7) as a dictionary of terms, each a function of one rendered view.

The loss is the sum of the terms. A custom term is a function that you pass by name to `make_step`
or `fit`. It is logged, checked for NaN and plotted like the built-in terms:

    def dark(rendered, target, aux):
        return 0.1 * jnp.mean(rendered.linear)

    step = make_step(cfg, terms={"dark": dark})

JAX calls terms while it traces a step, so they must be pure and see shapes instead of values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from p2gs_jax.config import FitConfig, LossConfig
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.ssim import one_less_ssim
from p2gs_jax.photometry.appearance import Correction, Corrections, regularisation
from p2gs_jax.photometry.luminance import ENTRIES, Curves, cumulative, enhanced, pseudo_curve
from p2gs_jax.train.exposure_loss import ColorPairs, relative_exposure_loss
from p2gs_jax.train.lidar_depths import lidar_loss
from p2gs_jax.types import GAMMA_SRGB, Array, Capture, Measured, Photometry

Image = Float[Array, "h w 3"]
Layer = Float[Array, "h w"]

# Published weights of Luminance-GS.
ENHANCED, CURVE = 0.5, 10.0
# Published: 1 in the first 3 of 10,000 steps, then 0.1. Ours: 0.1 in all steps.
EQUALIZED = 0.1
PSEUDO, PSEUDO_EQUALIZED, SMOOTH = 0.5, 0.01, 0.1  # weights in `curve_prior`
# Mean brightness to which the contrast term scales photographs; side of its squares, pixels.
CONTRAST_LEVEL, POOL = 0.5, 4


class Rendered(NamedTuple):
    """The render of a training view."""

    linear: Image  # linear HDR radiance, premultiplied by alpha
    alpha: Layer  # accumulated opacity
    # alpha-weighted camera z, scene units; None where no term has `needs_depth`
    depth: Layer | None
    # display values, not clamped; over the photograph's background if it has one
    ldr: Image
    # `ldr`, except where a saturated photograph cannot contradict it: there the photograph itself,
    # so that no gradient arises (`LossConfig.censored`)
    judged: Image
    # `ldr` without the learned correction; None unless Luminance-GS learns a correction
    uncorrected: Image | None


class Target(NamedTuple):
    """The photograph of the view."""

    ldr: Image  # display values in [0, 1], over its background if it has one
    mask: Layer  # 1 = use, 0 = ignore
    alpha: Layer | None  # its opacity, or None
    measured: Measured | None  # depths measured by a laser scanner, or None


class Aux(NamedTuple):
    """Further inputs of a term."""

    view: Int[Array, ""]  # row of the view in `Photometry`
    capture: Capture  # exposure, gamma, white balance and camera of the view
    photometry: Photometry  # of all training views
    appearance: Corrections | None  # learned corrections of all training views, or None
    correction: Correction | None  # learned correction of this view, or None
    other_view: Int[Array, ""]  # row of a second view, drawn at random
    # photographed colours of the same points in two views, if `relative_exposure` compares them
    pairs: ColorPairs | None


LossTerm = Callable[[Rendered, Target, Aux], Float[Array, ""] | None]
"""A weighted loss term of one view; it returns None if it does not apply to such a view.

If the function has the attribute `needs_depth = True`, `Rendered.depth` is computed.
"""


@dataclass(frozen=True)
class Term:
    """A built-in term: `weight` times the function `BUILT_IN[name]`.

    Terms of equal fields are equal, so that fits share programs.
    """

    name: str
    weight: float = 1.0
    options: tuple[Any, ...] = ()  # further arguments of the function
    needs_depth: bool = False  # see `LossTerm`

    def __call__(self, rendered: Rendered, target: Target, aux: Aux) -> Float[Array, ""] | None:
        """Return the weighted value."""
        value = BUILT_IN[self.name](rendered, target, aux, *self.options)
        return value if value is None or self.weight == 1.0 else self.weight * value


def loss_terms(
    cfg: FitConfig, changed: Mapping[str, LossTerm | None] | None = None
) -> dict[str, LossTerm]:
    """Return the terms of a configuration by name; a weight of None leaves a term out.

    Terms in `changed` are added or replace the term of the same name; None removes a term.
    UserError: there is no term to remove.
    """
    loss, photometry, kind = cfg.loss, cfg.photometry, cfg.photometry.appearance
    relative, priors = loss.relative_exposure.weight, loss.regularizers
    found = [Term("l1", options=(1 - (loss.dssim_weight or 0.0),))]
    if loss.dssim_weight is not None:
        found.append(Term("dssim", loss.dssim_weight))
    if kind == "luminance":
        found += [Term("enhanced", options=(loss,)), Term("contrast"), Term("curve", CURVE)]
    if loss.alpha is not None:
        found.append(Term("alpha", loss.alpha))
    if loss.lidar is not None:
        found.append(Term("lidar", loss.lidar, needs_depth=True))
    if relative is not None:
        found.append(Term("relative_exposure", relative, (loss, photometry)))
    weights = {name: getattr(priors, name) for name in PRIORS}
    found += [Term(name, weight) for name, weight in weights.items() if weight is not None]
    if kind is not None and priors.appearance is not None:
        found.append(Term("appearance", priors.appearance, (kind,)))
    terms: dict[str, LossTerm | None] = {term.name: term for term in found}
    for name in (name for name, term in (changed or {}).items() if term is None):
        if name not in terms:
            why = f"there is no loss term {name!r} to remove."
            raise UserError(why, fix=f"name one of these: {', '.join(terms)}")
    terms |= changed or {}
    return {name: term for name, term in terms.items() if term is not None}


# ------------------------------------------------------------- photographs against renders
#
# The photometric loss (paper, eq. 8) is a weighted sum of the absolute error and the dissimilarity.
# Predictions may exceed 1; with `LossConfig.censored` they are censored first. Pixels of mask 0 get
# exactly zero gradient.


def censor(ldr: Image, target: Image, saturation: float) -> Image:
    """Replace predictions that a saturated photograph cannot contradict by the photograph.

    A photographed value at or above `saturation` is only a lower bound of the brightness. A
    prediction at or above `saturation` agrees with it and gets no gradient.
    """
    agrees = (target >= saturation) & (ldr >= saturation)
    return jnp.where(agrees, target, ldr)


def absolute_error(ldr: Image, target: Image, mask: Layer, weight: float = 1.0) -> Float[Array, ""]:
    """Return the weighted mean absolute difference over valid pixels; 0 without valid pixels."""
    valid = jnp.maximum(3 * jnp.sum(mask), 1.0)
    absolute = jnp.where(mask[..., None] > 0, jnp.abs(ldr - target), 0.0)
    return weight * jnp.sum(absolute * mask[..., None]) / valid


def dissimilarity(ldr: Image, target: Image, mask: Layer) -> Float[Array, ""]:
    """Return 1 - SSIM over valid pixels."""
    return one_less_ssim(jnp.where(mask[..., None] > 0, ldr, 0.0), target, mask)


# ------------------------------------------------------------------------------- priors


def variance(x: Float[Array, " v"]) -> Float[Array, ""]:
    """Return the variance (divided by v) in two passes: exact at large means, smooth at zero."""
    return jnp.mean((x - jnp.mean(x)) ** 2)


# The paper's three priors (eq. 10) fix the global scale, the spread of exposures (and shrink it:
# docs/photometry.md, 3) and the tone. Our two priors fix the scale gauge only, and the power gauge.
PRIORS: dict[str, Callable[[Photometry], Float[Array, ""]]] = {
    "exposure_scale": lambda p: jnp.mean((p.exposures - 1) ** 2),
    "exposure_variance": lambda p: variance(p.exposures),
    "gamma_prior": lambda p: jnp.mean((p.gammas - GAMMA_SRGB) ** 2),
    "log_exposure_mean": lambda p: jnp.mean(p.log_exposures) ** 2,
    "gamma_mean_variance": lambda p: (jnp.mean(p.gammas) - GAMMA_SRGB) ** 2 + variance(p.gammas),
}


# ------------------------------------------------------------------------- Luminance-GS
#
# As published: 0.5 times the photometric loss between the render and the enhanced photograph, a
# contrast term between neighbouring squares of 4x4 pixels, and 10 times the prior on the curve.
# Ours: the render is compared with the photograph itself through the inverse curve, which gets no
# gradient from this (published: a second colour per Gaussian). D-SSIM moves the Gaussians only.


def enhanced_loss(
    rendered: Image, photograph: Image, mask: Layer, curves: Curves, cfg: LossConfig
) -> Float[Array, ""]:
    """Return the weighted photometric loss of a render against the enhanced photograph."""
    target, weight = enhanced(photograph, curves), cfg.dssim_weight
    if cfg.censored:
        rendered = censor(rendered, target, cfg.saturation)
    loss = absolute_error(rendered, target, mask, 1 - (weight or 0.0))
    if weight is not None:
        loss = loss + weight * dissimilarity(rendered, target, mask)
    return ENHANCED * loss


def curve_prior(curves: Curves, photograph: Image, mask: Layer) -> Float[Array, ""]:
    """Return weighted squared distances of curve, pseudo curve and histogram equalisation.

    A further summand is the curve's roughness. The histogram is of the photograph's valid pixels.
    """
    grey = photograph[::4, ::4].mean(-1).reshape(-1)
    equalized = lax.stop_gradient(cumulative(grey, mask[::4, ::4].reshape(-1), ENTRIES))
    pseudo = pseudo_curve(curves.shape)

    def mean_square(a, b):
        return jnp.mean((a - b) ** 2)

    return (
        EQUALIZED * mean_square(curves.curve, equalized)
        + SMOOTH * jnp.mean(jnp.diff(curves.curve) ** 2)
        + PSEUDO
        * (mean_square(pseudo, curves.curve) + PSEUDO_EQUALIZED * mean_square(pseudo, equalized))
    )


def contrast_loss(rendered: Image, photograph: Image, mask: Layer) -> Float[Array, ""]:
    """Return the error of steps between neighbouring squares, against the brightened photograph.

    `rendered` holds enhanced display values. Squares with a masked pixel do not count.
    """
    whole = _pooled(mask) > 1.0 - 1e-3
    mean = (mask[..., None] * photograph).sum() / jnp.maximum(3 * mask.sum(), 1.0)
    raised = CONTRAST_LEVEL / jnp.maximum(mean, 1e-3)
    error = jnp.where(whole, _pooled((raised * photograph - rendered).mean(-1)), 0.0)
    total = jnp.zeros(())
    for axis in (0, 1):
        both = whole[1:] & whole[:-1] if axis == 0 else whole[:, 1:] & whole[:, :-1]
        total += 2 * jnp.sum(jnp.where(both, jnp.diff(error, axis=axis) ** 2, 0.0))
    return total / jnp.maximum(whole.sum(), 1)


def _pooled(image: Layer) -> Float[Array, "y x"]:
    height, width = (n // POOL * POOL for n in image.shape)
    squares = image[:height, :width].reshape(height // POOL, POOL, width // POOL, POOL)
    return squares.mean((1, 3))


def opacity_error(alpha: Layer, target: Layer, mask: Layer) -> Float[Array, ""]:
    """Return the mean absolute difference of opacities over valid pixels."""
    return jnp.sum(mask * jnp.abs(alpha - target)) / jnp.maximum(jnp.sum(mask), 1.0)


# Functions of (rendered, target, aux, *options).
BUILT_IN: dict[str, Callable[..., Any]] = {
    "l1": lambda r, t, a, weight: absolute_error(r.judged, t.ldr, t.mask, weight),
    "dssim": lambda r, t, a: dissimilarity(r.judged, t.ldr, t.mask),
    "enhanced": lambda r, t, a, loss: enhanced_loss(
        r.uncorrected, t.ldr, t.mask, a.correction, loss
    ),
    "contrast": lambda r, t, a: contrast_loss(r.uncorrected, t.ldr, t.mask),
    "curve": lambda r, t, a: curve_prior(a.correction, t.ldr, t.mask),
    "alpha": lambda r, t, a: None if t.alpha is None else opacity_error(r.alpha, t.alpha, t.mask),
    "lidar": lambda r, t, a: (
        None if t.measured is None else lidar_loss(r.alpha, r.depth, t.measured)
    ),
    "relative_exposure": lambda r, t, a, loss, formed: relative_exposure_loss(
        r.linear, (a.view, a.other_view), a.pairs, a.photometry, loss, formed
    ),
    "appearance": lambda r, t, a, kind: regularisation(a.appearance, kind),
}
BUILT_IN |= {
    name: lambda r, t, a, prior=prior: prior(a.photometry) for name, prior in PRIORS.items()
}
