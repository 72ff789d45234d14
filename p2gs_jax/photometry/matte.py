"""Pictures over a background: photographs with alpha and renders are put over it alike.

A file with alpha holds the display colour c of what is there and how much of the pixel that covers;
published comparisons show a c + (1 - a) B, in display values. So is a render: its radiance is
premultiplied by the opacity A, what is there has the radiance L / A and the display colour
T(e L / A), and the picture is A T(e L / A) + (1 - A) B. Whatever the curve, the exposure and B, the
two agree where A = a and T(e L / A) = c. With a linear curve and e = 1 it is 3DGS's L + (1 - A) B.
B passes no camera: it is the same under every exposure, as in the photographs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from p2gs_jax.core.numerics import Values, namespace

# Opacities below this count as this where radiance is divided by them.
LEAST = 1e-3


class Matte(NamedTuple):
    """What a render is put over, and how much of it shows.

    Attributes:
        alpha: opacity of the render.
        backdrop: display values of red, green, blue, of all pixels or of each.
    """

    alpha: Float[Array, "h w"] | Any
    backdrop: Float[Array, " 3"] | Float[Array, "h w 3"] | Any

    def every(self, stride: int) -> Matte:
        """Return it of every so many pixels along each axis."""
        one_in = (slice(None, None, stride),) * 2
        behind = self.backdrop if self.backdrop.ndim == 1 else self.backdrop[one_in]
        return Matte(self.alpha[one_in], behind)


def uncovered(linear: Values, matte: Matte | None) -> Values:
    """Return the radiance of what is there: without the share of the pixel that it covers."""
    if matte is None:
        return linear
    xp: Any = namespace(linear, matte.alpha)
    return linear / xp.maximum(matte.alpha, LEAST)[..., None]


def composited(ldr: Values, matte: Matte | None) -> Values:
    """Return display values of what is there, over the background; None: there is none."""
    if matte is None:
        return ldr
    alpha = matte.alpha[..., None]
    shown: Any = alpha * ldr + (1 - alpha) * matte.backdrop
    return shown
