"""What cameras on a drive do to the light besides exposing it: tints, dark corners, responses.

Vignetting follows the cosine-fourth law, so that no fitted polynomial in r^2 is exactly right.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.synth.sensor import encode
from p2gs_jax.synth.settings import Curve

Curves = Curve | np.ndarray
Tints = Literal["camera", "view", "dark"]
# Extent of errors that neighbouring points share, in units of half the image's diagonal.
NEIGHBOURHOOD, WAVES = 0.2, 16


def make_white_balance(
    kind: Tints,
    cameras: Int[np.ndarray, " v"],
    exposures: Float[np.ndarray, " v"],
    *,
    ev: float = 0.1,
    seed: int = 4,
) -> Float[np.ndarray, "v 3"]:
    """Return factors on red, green, blue of every view; the mean of their logarithms is 0.

    Args:
        kind: `camera`, `view`: factors of each channel drawn for each; `dark`: views darker than
            the median are bluer than the others.
        cameras: of each view.
        exposures: of each view.
        ev: standard deviation of a channel, or how much bluer dark views are, stops.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    if kind == "dark":
        dark = exposures < np.median(exposures)
        stops = np.where(dark[:, None], np.array([-ev / 2, 0, ev]), 0.0)
    elif kind == "camera":
        stops = ev * rng.standard_normal((int(cameras.max()) + 1, 3))[cameras]
    else:
        stops = ev * rng.standard_normal((len(cameras), 3))
    return 2.0 ** (stops - stops.mean(1, keepdims=True))


def falloff(
    radius: Float[np.ndarray, "..."], corner_loss: Float[np.ndarray, "..."] | float
) -> Float[np.ndarray, "..."]:
    """Return the share of the light that arrives: cos^4 of the angle to the axis.

    Args:
        radius: distance from the centre of the image, 1 in its corners.
        corner_loss: share lost there, in [0, 1).
    """
    # cos^2 = 1 / (1 + tan^2), and the tangent grows with the radius.
    return (1 + ((1 - corner_loss) ** -0.5 - 1) * radius**2) ** -2.0


def encode_by(
    exposed: Float[np.ndarray, "o 3"], curve: Curves, cameras: Int[np.ndarray, " o"]
) -> Float[np.ndarray, "o 3"]:
    """Return display values of exposed radiance under the response of each camera and channel.

    Args:
        exposed: radiance times exposure.
        curve: response of all, or names that broadcast to (cameras, 3).
        cameras: of each row.
    """
    if isinstance(curve, str):
        return encode(exposed, curve)
    of_each = np.broadcast_to(curve, (int(cameras.max(initial=0)) + 1, 3))[cameras]
    out = np.empty_like(exposed)
    for name in np.unique(of_each):
        out[of_each == name] = encode(exposed[of_each == name], name)
    return out


def smooth_errors(
    views: Int[np.ndarray, " o"],
    positions: Float[np.ndarray, "o 2"],
    view_count: int,
    seed: tuple[int, ...],
) -> Float[np.ndarray, " o"]:
    """Return errors of variance 1 that vary smoothly over each image and differ between images.

    Sums of random waves approach a Gaussian process with the covariance
    exp(-d^2 / (2 NEIGHBOURHOOD^2)) (Rahimi and Recht 2007).

    Args:
        views: row of the view.
        positions: in its image.
        view_count: number of views.
        seed: of the waves.
    """
    rng = np.random.default_rng(seed)
    total = np.zeros(len(views))
    for _ in range(WAVES):
        wave = rng.standard_normal((view_count, 2)) / NEIGHBOURHOOD
        phase = rng.uniform(0, 2 * np.pi, view_count)
        total += np.cos((wave[views] * positions).sum(1) + phase[views])
    return total * np.sqrt(2 / WAVES)
