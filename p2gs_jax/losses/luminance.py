"""The terms of Luminance-GS beside the one that compares with the photograph.

As published: half the photometric loss between the render and the enhanced photograph, a contrast
term between neighbouring squares of 4x4 pixels, and ten times the prior on the curve. Ours: the
render meets the photograph itself through the inverse curve, through which nothing is learned of
it (published: a second colour per Gaussian), and D-SSIM moves the Gaussians only.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.config import LossConfig
from p2gs_jax.losses.image import photometric_loss
from p2gs_jax.photometry.luminance import ENTRIES, Curves, cumulative, enhanced, pseudo_curve

# Published weights.
ENHANCED, CURVE = 0.5, 10.0
# Published: 1 in the first three of ten thousand steps, then 0.1; ours: 0.1 throughout.
EQUALIZED = 0.1
PSEUDO, PSEUDO_EQUALIZED, SMOOTH = 0.5, 0.01, 0.1
# Mean brightness that contrast is raised to.
CONTRAST_LEVEL, POOL = 0.5, 4


def luminance_terms(
    rendered: Float[Array, "h w 3"],
    photograph: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    view: Curves,
    cfg: LossConfig,
) -> dict[str, Float[Array, ""]]:
    """Return the weighted terms `enhanced`, `contrast` and `curve`.

    Args:
        rendered: enhanced display values.
        photograph: display values.
        mask: 1 = use.
        view: how the photograph was taken.
        cfg: of the photometric loss.
    """
    target = enhanced(photograph, view)
    compared = photometric_loss(rendered, target, mask, cfg)
    return {
        "enhanced": ENHANCED * sum(compared.values(), jnp.zeros(())),
        "contrast": contrast_loss(rendered, photograph, mask),
        "curve": CURVE * curve_prior(view, photograph, mask),
    }


def curve_prior(
    view: Curves, photograph: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, ""]:
    """Return how far a curve is from histogram equalisation and its pseudo curve, and how rough.

    Args:
        view: with the curve.
        photograph: whose histogram it is.
        mask: 1 = use.
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


def contrast_loss(
    rendered: Float[Array, "h w 3"], photograph: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, ""]:
    """Return how far steps between neighbouring squares are from the photograph's, brightened.

    Squares with a masked pixel do not count.

    Args:
        rendered: enhanced display values.
        photograph: display values.
        mask: 1 = use.
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


def _pooled(image: Float[Array, "h w"]) -> Float[Array, "y x"]:
    height, width = (n // POOL * POOL for n in image.shape)
    squares = image[:height, :width].reshape(height // POOL, POOL, width // POOL, POOL)
    return squares.mean((1, 3))
