"""Colour correction of PPISP: a homography of chromaticities that keeps R + G + B.

Colours are taken as homogeneous (R, G, R + G + B), so that (R, G) / (R + G + B) are chromaticities
in a plane. The homography is given by where it takes four of them: blue, red, green and neutral.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Chromaticities of blue, red, green and neutral, homogeneous.
SOURCES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1 / 3, 1 / 3, 1.0]])
# What a unit of each parameter moves of (r, g) of its point: they whiten the parameters, so that
# all change the image about equally (paper, B.1; values of the reference implementation).
PRECONDITIONERS = np.array(
    [
        [[0.0480542, -0.0043631], [-0.0043631, 0.0481283]],
        [[0.0580570, -0.0179872], [-0.0179872, 0.0431061]],
        [[0.0433336, -0.0180537], [-0.0180537, 0.0580500]],
        [[0.0128369, -0.0034654], [-0.0034654, 0.0128158]],
    ]
)
PARAMETERS = 8
# Added to the intensity that is divided by, so that black stays black.
EPSILON = 1e-5


def offsets(parameters: Float[Array, "... 8"]) -> Float[Array, "... 4 2"]:
    """Return how far the four chromaticities move."""
    pairs = parameters.reshape(*parameters.shape[:-1], 4, 2)
    blocks = jnp.asarray(PRECONDITIONERS, parameters.dtype)
    return jnp.einsum("...ki,kij->...kj", pairs, blocks)


def homography(parameters: Float[Array, " 8"]) -> Float[Array, "3 3"]:
    """Return the map of homogeneous chromaticities that takes `SOURCES` to where they move.

    With the sources of blue, red, green as the columns of S and their targets as those of T,
    H S = T diag(k). The neutral source is S (1, 1, 1) / 3, so T k must be the neutral target up to
    scale: k is its coordinates in the basis T.

    Args:
        parameters: two of each point; zeros give the identity.
    """
    sources = jnp.asarray(SOURCES, parameters.dtype)
    targets = sources.at[:, :2].add(offsets(parameters))
    blue, red, green, neutral = targets
    # Cramer's rule; the determinant of T is a common factor.
    k = jnp.stack(
        [
            neutral @ jnp.cross(red, green),
            neutral @ jnp.cross(green, blue),
            neutral @ jnp.cross(blue, red),
        ]
    )
    inverse = jnp.asarray(np.linalg.inv(SOURCES[:3].T), parameters.dtype)
    h = (targets[:3].T * k) @ inverse
    return h / h[2, 2]


def recolored(rgb: Float[Array, "... 3"], parameters: Float[Array, " 8"]) -> Float[Array, "... 3"]:
    """Return colours under the homography; R + G + B stays, but for `EPSILON`.

    Args:
        rgb: linear light.
        parameters: of `homography`.
    """
    intensity = rgb.sum(-1, keepdims=True)
    moved = jnp.concatenate([rgb[..., :2], intensity], -1) @ homography(parameters).T
    # Parameters that throw a colour beyond the horizon would turn it negative.
    moved = moved * intensity / (jnp.maximum(moved[..., 2:], 0.0) + EPSILON)
    red, green = moved[..., 0], moved[..., 1]
    return jnp.stack([red, green, moved[..., 2] - red - green], -1)
