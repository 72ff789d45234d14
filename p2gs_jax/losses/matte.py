"""The photometric loss of a photograph with alpha: both are put over one background."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.config import FitConfig
from p2gs_jax.losses.image import censor, photometric_loss
from p2gs_jax.losses.luminance import luminance_terms
from p2gs_jax.photometry.appearance import Correction
from p2gs_jax.photometry.formation import Matte, composited, formation, uncovered
from p2gs_jax.photometry.luminance import Curves
from p2gs_jax.types import Batch, Capture, Render

# Photographed colours of pixels that are less opaque are black.
LEAST_SEEN = 0.5 / 255


def unit(stored: Array) -> Float[Array, "..."]:
    """Return stored integers as floats, the largest as 1; floats as they are."""
    scale = float(jnp.iinfo(stored.dtype).max) if stored.dtype.kind == "u" else 1.0
    return stored.astype(jnp.float32) / scale


def matted_loss(
    render: Render,
    batch: Batch,
    capture: Capture,
    correction: Correction | None,
    cfg: FitConfig,
) -> tuple[Float[Array, "h w 3"], dict[str, Float[Array, ""]]]:
    """Return the picture over the background, unclamped, and the weighted terms of the loss.

    What a saturated photograph cannot contradict is decided on what is there, before the
    background: a white one saturates nothing.

    Args:
        render: of the view.
        batch: its photograph, premultiplied, with alpha and backdrop.
        capture: what it did to the light.
        correction: of display values, or None.
        cfg: weights and formation model.
    """
    assert batch.alpha is not None
    assert batch.backdrop is not None
    held, alpha = unit(batch.ldr), unit(batch.alpha)
    mask = batch.mask.astype(jnp.float32)
    photograph = held + (1 - alpha[..., None]) * batch.backdrop
    matte = Matte(render.alpha, batch.backdrop)
    there = uncovered(render.linear, matte)
    own = formation(there, capture, cfg.photometry, correction)
    ldr = composited(own, matte)
    judged, loss = ldr, cfg.loss
    if loss.censored:
        seen = alpha[..., None] > LEAST_SEEN
        straight = jnp.where(seen, held / jnp.maximum(alpha, LEAST_SEEN)[..., None], 0.0)
        judged = composited(censor(own, straight, loss.saturation), matte)
        loss = dataclasses.replace(loss, censored=False)
    terms = dict(photometric_loss(judged, photograph, mask, loss))
    if isinstance(correction, Curves):
        light = composited(formation(there, capture, cfg.photometry), matte)
        terms |= luminance_terms(light, photograph, mask, correction, cfg.loss)
    if loss.alpha is not None:
        away = jnp.sum(mask * jnp.abs(render.alpha - alpha)) / jnp.maximum(jnp.sum(mask), 1.0)
        terms["alpha"] = loss.alpha * away
    return ldr, terms
