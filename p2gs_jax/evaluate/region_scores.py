"""Scores of a drive's views over static pixels, over moving objects, and over all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from p2gs_jax.evaluate.lpips import LpipsWeights, lpips
from p2gs_jax.evaluate.metrics import psnr
from p2gs_jax.evaluate.ssim import ssim_map

PARTS = ("whole", "static", "moving")
# Of fewer pixels nothing is said.
FEWEST_PIXELS = 64


def parts_of(
    mask: Float32[np.ndarray, "h w"], moving: Bool[np.ndarray, "h w"]
) -> dict[str, Float32[np.ndarray, "h w"]]:
    """Return masks by name, without those that have too few pixels.

    Args:
        mask: 1 = use.
        moving: covered by the boxes of what moves.
    """
    masks = {"whole": mask, "static": mask * ~moving, "moving": mask * moving}
    return {k: m.astype(np.float32) for k, m in masks.items() if m.sum() >= FEWEST_PIXELS}


def region_scores(
    weights: LpipsWeights | None,
    ldr: Float32[np.ndarray, "h w 3"],
    target: Float32[np.ndarray, "h w 3"],
    masks: Mapping[str, Float32[np.ndarray, "h w"]],
) -> dict[str, dict[str, float]]:
    """Return PSNR, SSIM and, with weights, LPIPS of each part.

    SSIM is the mean of the whole image's map over the part. LPIPS is the distance with the
    photograph outside of the part, over the part's share of the image.

    Args:
        weights: of LPIPS, or None.
        ldr: rendered image.
        target: photograph.
        masks: from `parts_of`.
    """
    if not masks:
        return {}
    pair = jnp.asarray(ldr), jnp.asarray(target)
    similar = _similarity(*pair, masks["whole"])
    out: dict[str, dict[str, float]] = {}
    for name, mask in masks.items():
        if name == "static" and "moving" not in masks:
            out[name] = out["whole"]
            continue
        row = {
            "psnr": float(psnr(*pair, mask)),
            "ssim": float(jnp.sum(similar * mask) / jnp.sum(mask)),
        }
        if weights is not None:
            row["lpips"] = float(lpips(weights, *pair, jnp.asarray(mask)) / mask.mean())
        out[name] = row
    return out


@jax.jit
def _similarity(
    ldr: Float[Array, "h w 3"], target: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, "h w"]:
    """Return the SSIM of each pixel; pixels that do not count are alike."""
    seen = jnp.where(mask[..., None] > 0, ldr, target)
    return ssim_map(seen.transpose(2, 0, 1), target.transpose(2, 0, 1)).mean(0)


def mean_of_parts(rows: Sequence[Mapping[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the means of views that have each part, and how many these are.

    Args:
        rows: from `region_scores`, one a view.
    """
    out = {}
    for name in PARTS:
        there = [row[name] for row in rows if name in row]
        if there:
            out[name] = {k: float(np.mean([r[k] for r in there])) for k in there[0]}
            out[name]["views"] = len(there)
    return out
