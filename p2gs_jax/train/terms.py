"""The composed loss (paper, eq. 7) as a dictionary of terms, each a function of one rendered view.

The loss is the sum of the dictionary. A term that is a function of yours is passed by name to
`make_step` or `fit`, and is logged, checked for NaN and drawn like the built-in ones:

    def dark(rendered, target, aux):
        return 0.1 * jnp.mean(rendered.linear)

    step = make_step(cfg, terms={"dark": dark})

Terms are called while a step is traced, so they are pure and see shapes, not values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from p2gs_jax.config import FitConfig, LossConfig
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
# Published: 1 in the first three of ten thousand steps, then 0.1; ours: 0.1 throughout.
EQUALIZED = 0.1
PSEUDO, PSEUDO_EQUALIZED, SMOOTH = 0.5, 0.01, 0.1
# Mean brightness that contrast is raised to, and the side of the squares, pixels.
CONTRAST_LEVEL, POOL = 0.5, 4


class Rendered(NamedTuple):
    """A training view as it was rendered."""

    linear: Image  # linear HDR radiance, premultiplied by alpha
    alpha: Layer  # accumulated opacity
    # alpha-weighted camera z, scene units; None where no term has `needs_depth`
    depth: Layer | None
    # display values, over the photograph's background where it has one; not clamped
    ldr: Image
    # the same where a saturated photograph can contradict it, and elsewhere the photograph itself,
    # from which no gradient comes (`LossConfig.censored`)
    judged: Image
    # `ldr` without the learned correction; None unless Luminance-GS learns one
    uncorrected: Image | None


class Target(NamedTuple):
    """The photograph of the view."""

    ldr: Image  # display values in [0, 1], over its background where it has one
    mask: Layer  # 1 = use, 0 = ignore
    alpha: Layer | None  # its opacity, or None
    measured: Measured | None  # depths that a laser scanner measured, or None


class Aux(NamedTuple):
    """What else a term may know."""

    view: Int[Array, ""]  # row of the view in `Photometry`
    capture: Capture  # what its camera did to the light
    photometry: Photometry  # of all training views
    appearance: Corrections | None  # learned corrections of all training views, or None
    correction: Correction | None  # that of this view, or None
    other_view: Int[Array, ""]  # row of a second view, drawn at random
    # photographed colours of the same points in two views, where `relative_exposure` compares them
    pairs: ColorPairs | None


LossTerm = Callable[[Rendered, Target, Aux], Float[Array, ""] | None]
"""A weighted term of the loss of one view; None where it says nothing of a view like this.

The attribute `needs_depth = True` on it makes `Rendered.depth` known.
"""


@dataclass(frozen=True)
class Term:
    """A built-in term: `weight` times `BUILT_IN[name]`, which is given what else it needs.

    It is equal to another where its parts are, so that fits share programs.
    """

    name: str
    weight: float = 1.0
    given: tuple[Any, ...] = ()
    needs_depth: bool = False  # see `LossTerm`

    def __call__(self, rendered: Rendered, target: Target, aux: Aux) -> Float[Array, ""] | None:
        """Return the weighted value."""
        value = BUILT_IN[self.name](rendered, target, aux, *self.given)
        return value if value is None or self.weight == 1.0 else self.weight * value


def loss_terms(
    cfg: FitConfig, changed: Mapping[str, LossTerm | None] | None = None
) -> dict[str, LossTerm]:
    """Return the terms that a configuration asks for, by name; a weight of None leaves a term out.

    Those in `changed` are added, or take the place of those of the same name; None takes one away.
    """
    loss, photometry, kind = cfg.loss, cfg.photometry, cfg.photometry.appearance
    relative, priors = loss.relative_exposure.weight, loss.regularizers
    found = [Term("l1", given=(1 - (loss.dssim_weight or 0.0),))]
    if loss.dssim_weight is not None:
        found.append(Term("dssim", loss.dssim_weight))
    if kind == "luminance":
        found += [Term("enhanced", given=(loss,)), Term("contrast"), Term("curve", CURVE)]
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
    terms |= changed or {}
    return {name: term for name, term in terms.items() if term is not None}


# ------------------------------------------------------------- photographs against renders


def censor(ldr: Image, target: Image, saturation: float) -> Image:
    """Replace predictions that a saturated photograph cannot contradict by the photograph.

    Where the photograph is at or above `saturation` it only says "at least this bright": a
    prediction at least that bright is right and gets no gradient.
    """
    agrees = (target >= saturation) & (ldr >= saturation)
    return jnp.where(agrees, target, ldr)


def absolute_error(
    ldr: Image,
    target: Image,
    mask: Layer,
    weight: float = 1.0,
) -> Float[Array, ""]:
    """Return the weighted mean absolute difference over valid pixels; 0 without any."""
    valid = jnp.maximum(3 * jnp.sum(mask), 1.0)
    absolute = jnp.where(mask[..., None] > 0, jnp.abs(ldr - target), 0.0)
    return weight * jnp.sum(absolute * mask[..., None]) / valid


def photometric_loss(
    ldr: Image,
    target: Image,
    mask: Layer,
    cfg: LossConfig,
) -> dict[str, Float[Array, ""]]:
    """Return the weighted terms `l1` and `dssim` (paper, eq. 8) of a prediction, censored if asked.

    `ldr` may exceed 1; pixels with mask 0 get exactly zero gradient.
    """
    if cfg.censored:
        ldr = censor(ldr, target, cfg.saturation)
    weight = cfg.dssim_weight
    terms = {"l1": absolute_error(ldr, target, mask, 1 - (weight or 0.0))}
    if weight is not None:
        terms["dssim"] = weight * dissimilarity(ldr, target, mask)
    return terms


def dissimilarity(ldr: Image, target: Image, mask: Layer) -> Float[Array, ""]:
    """Return 1 - SSIM over valid pixels."""
    return one_less_ssim(jnp.where(mask[..., None] > 0, ldr, 0.0), target, mask)


# ------------------------------------------------------------------------------- priors


def variance(x: Float[Array, " v"]) -> Float[Array, ""]:
    """Return the population variance in two passes: exact at large means, smooth at zero."""
    return jnp.mean((x - jnp.mean(x)) ** 2)


# The paper's three (eq. 10) resolve: global scale; spread (which also shrinks true spread, see
# docs/photometry.md, 3); tone. Ours resolve: the scale gauge alone; the power gauge.
PRIORS: dict[str, Callable[[Photometry], Float[Array, ""]]] = {
    "exposure_scale": lambda p: jnp.mean((p.exposures - 1) ** 2),
    "exposure_variance": lambda p: variance(p.exposures),
    "gamma_prior": lambda p: jnp.mean((p.gammas - GAMMA_SRGB) ** 2),
    "log_exposure_mean": lambda p: jnp.mean(p.log_exposures) ** 2,
    "gamma_mean_variance": lambda p: (jnp.mean(p.gammas) - GAMMA_SRGB) ** 2 + variance(p.gammas),
}


# ------------------------------------------------------------------------- Luminance-GS
#
# As published: half the photometric loss between the render and the enhanced photograph, a
# contrast term between neighbouring squares of 4x4 pixels, and ten times the prior on the curve.
# Ours: the render meets the photograph itself through the inverse curve, through which nothing is
# learned of it (published: a second colour per Gaussian), and D-SSIM moves the Gaussians only.


def enhanced_loss(
    rendered: Image,
    photograph: Image,
    mask: Layer,
    view: Curves,
    cfg: LossConfig,
) -> Float[Array, ""]:
    """Return the weighted photometric loss of enhanced display values against the photograph's."""
    compared = photometric_loss(rendered, enhanced(photograph, view), mask, cfg)
    return ENHANCED * sum(compared.values(), jnp.zeros(()))


def curve_prior(view: Curves, photograph: Image, mask: Layer) -> Float[Array, ""]:
    """Return how far a curve is from histogram equalisation and its pseudo curve, and how rough.

    The histogram is the photograph's, over pixels of mask 1.
    """
    grey = photograph[::4, ::4].mean(-1).reshape(-1)
    equalized = lax.stop_gradient(cumulative(grey, mask[::4, ::4].reshape(-1), ENTRIES))
    pseudo = pseudo_curve(view.shape)

    def apart(a, b):
        return jnp.mean((a - b) ** 2)

    return (
        EQUALIZED * apart(view.curve, equalized)
        + SMOOTH * jnp.mean(jnp.diff(view.curve) ** 2)
        + PSEUDO * (apart(pseudo, view.curve) + PSEUDO_EQUALIZED * apart(pseudo, equalized))
    )


def contrast_loss(rendered: Image, photograph: Image, mask: Layer) -> Float[Array, ""]:
    """Return how far steps between neighbouring squares are from the photograph's, brightened.

    `rendered` are enhanced display values. Squares with a masked pixel do not count.
    """
    whole = _pooled(mask) > 1.0 - 1e-3
    mean = (mask[..., None] * photograph).sum() / jnp.maximum(3 * mask.sum(), 1.0)
    raised = CONTRAST_LEVEL / jnp.maximum(mean, 1e-3)
    apart = jnp.where(whole, _pooled((raised * photograph - rendered).mean(-1)), 0.0)
    total = jnp.zeros(())
    for axis in (0, 1):
        both = _both(whole, axis)
        total += 2 * jnp.sum(jnp.where(both, jnp.diff(apart, axis=axis) ** 2, 0.0))
    return total / jnp.maximum(whole.sum(), 1)


def _both(whole, axis: int):
    return whole[1:] & whole[:-1] if axis == 0 else whole[:, 1:] & whole[:, :-1]


def _pooled(image: Layer) -> Float[Array, "y x"]:
    height, width = (n // POOL * POOL for n in image.shape)
    squares = image[:height, :width].reshape(height // POOL, POOL, width // POOL, POOL)
    return squares.mean((1, 3))


def opacity_error(alpha: Layer, target: Layer, mask: Layer) -> Float[Array, ""]:
    """Return the mean difference of opacities over valid pixels."""
    apart = jnp.sum(mask * jnp.abs(alpha - target))
    return apart / jnp.maximum(jnp.sum(mask), 1.0)


# Functions of (rendered, target, aux) and what else a term is given.
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
