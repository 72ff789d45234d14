"""From COLMAP's axes (right, down, forward) to those of graphics (right, up, back), and back."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from p2gs_jax.render.harmonics import basis, degree_of
from p2gs_jax.types import Gaussians

# What a turn of 180 degrees about x does to coordinates.
FLIP = (1.0, -1.0, -1.0)


def half_turn(g: Gaussians) -> Gaussians:
    """Return the Gaussians turned by 180 degrees about x; twice is nothing."""
    flip = jnp.asarray(FLIP)
    direction = np.array([[0.36, 0.48, 0.8]], np.float32)
    degree = degree_of(g.sh.shape[1])
    # A half turn about an axis only changes signs of the harmonics.
    here, there = (
        np.array([float(b[0]) for b in basis(tuple(jnp.asarray(d).T), degree)])
        for d in (direction, direction * np.array(FLIP, np.float32))
    )
    return replace(
        g,
        means=g.means * flip,
        quats=g.quats * jnp.asarray([1.0, *FLIP]),
        sh=g.sh * jnp.asarray(np.sign(here * there), g.sh.dtype)[:, None],
    )
