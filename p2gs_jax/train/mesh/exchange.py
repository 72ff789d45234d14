"""What travels between the devices that share a group's Gaussians: splats there, gradients back.

A device projects its own Gaussians into all views of its group. Then each view's splats travel to
the device that composites it; the gradients of the splats go back by the inverse, which is also the
transpose (Grendel-GS, arXiv 2406.18533, divides a step in the same way).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from p2gs_jax.core.devices import GAUSSIANS


def to_views(shown, parts: int):
    """Return of a device's views all splats, from its part of the splats of all views.

    Args:
        shown: arrays [views of the group, rows, ...].
        parts: devices of the group.

    Returns:
        Arrays [views of the device, parts * rows, ...].
    """
    if parts == 1:
        return shown

    def sent(a):
        mine = a.reshape(parts, -1, *a.shape[1:])
        theirs = lax.all_to_all(mine, GAUSSIANS, 0, 0)
        together = jnp.moveaxis(theirs, 0, 1)
        return together.reshape(together.shape[0], -1, *a.shape[2:])

    return jax.tree.map(sent, shown)


def to_gaussians(v_shown, parts: int):
    """Return the inverse of `to_views`, for gradients."""
    if parts == 1:
        return v_shown

    def sent(a):
        by_part = a.reshape(a.shape[0], parts, -1, *a.shape[2:])
        theirs = lax.all_to_all(jnp.moveaxis(by_part, 1, 0), GAUSSIANS, 0, 0)
        return theirs.reshape(-1, *theirs.shape[2:])

    return jax.tree.map(sent, v_shown)
