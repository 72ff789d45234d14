"""Scores of single views and their means, the same for everything that is judged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32

from p2gs_jax.evaluate.lpips import LpipsWeights, lpips
from p2gs_jax.evaluate.metrics import psnr, ssim
from p2gs_jax.evaluate.region_scores import PARTS, mean_of_parts, region_scores


def view_scores(
    lpips_weights: LpipsWeights | None,
    ldr,
    target,
    mask,
    parts: Mapping[str, Float32[np.ndarray, "h w"]] | None = None,
) -> dict[str, Any]:
    """Return PSNR and SSIM of an image; LPIPS if there are weights for it; the same of parts."""
    row: dict[str, Any] = {
        "psnr": float(psnr(ldr, target, mask)),
        "ssim": float(ssim(ldr, target, mask)),
    }
    if lpips_weights is not None:
        row["lpips"] = float(lpips(lpips_weights, ldr, target, mask))
    return row if parts is None else {**row, **region_scores(lpips_weights, ldr, target, parts)}


class Collector:
    """Per-view scores, of drives also of parts of the views, and their means."""

    def __init__(self, rows: dict[str, dict[str, Any]] | None = None):
        """Begin with rows of views by name, or empty."""
        self.rows = {} if rows is None else rows

    def add(self, name: str, row: dict[str, Any]) -> None:
        """Take the scores of a view."""
        self.rows[name] = row

    def summary(self) -> dict:
        """Return the means, and the rows as `per_view`; empty without any."""
        if not self.rows:
            return {}
        rows = list(self.rows.values())
        keys = [k for k in rows[0] if k not in PARTS]
        means = {k: float(np.mean([r[k] for r in rows])) for k in keys}
        return {**means, **mean_of_parts(rows), "per_view": self.rows}
