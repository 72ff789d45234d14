"""Blocks become one scene: of each the Gaussians in its core."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from p2gs_jax.core.numerics import on_device
from p2gs_jax.districts.cut import Cut
from p2gs_jax.errors import UserError
from p2gs_jax.types import Gaussians


def merge_cores(cut: Cut, fitted: Sequence[Gaussians]) -> tuple[Gaussians, list[int]]:
    """Return the Gaussians whose centres lie in the core of the block that fitted them.

    Cores cover space once: nothing is there twice, and nothing is left out.

    Args:
        cut: of the scene.
        fitted: of each block, in its order.

    Returns:
        All of them, block after block, and how many each gave.

    Raises:
        UserError: there are none.
    """
    kept = [
        np.flatnonzero(cut.core(number, np.asarray(gaussians.means)))
        for number, gaussians in enumerate(fitted)
    ]
    counts = [len(rows) for rows in kept]
    if not sum(counts):
        raise UserError(
            "no block has a Gaussian in its core.", fix="use fewer --blocks, or more --steps"
        )

    def joined(*arrays) -> jax.Array:
        parts = [np.asarray(a)[rows] for a, rows in zip(arrays, kept, strict=True)]
        return on_device(np.concatenate(parts))

    return jax.tree.map(joined, *fitted), counts
