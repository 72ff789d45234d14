"""Camera response of PPISP: two powers that meet with equal slopes, and a gamma, by channel."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.core.numerics import unit_clip

# Of a channel: toe, shoulder, gamma, centre, as the optimiser sees them.
PARAMETERS = 4
LEAST_TOE, LEAST_SHOULDER, LEAST_GAMMA = 0.3, 0.3, 0.1
# Nearer to black or white than this the powers' slopes may be infinite: there they have none.
FLAT = 1e-6


def identity_response() -> Float[np.ndarray, " 4"]:
    """Return the parameters whose response is y = x: all powers 1, centre 1/2."""
    least = np.array([LEAST_TOE, LEAST_SHOULDER, LEAST_GAMMA])
    return np.append(np.log(np.expm1(1.0 - least)), 0.0)


def respond(light: Float[Array, "... 3"], raw: Float[Array, "3 4"]) -> Float[Array, "... 3"]:
    """Return display values of light; 0 stays 0, 1 stays 1, and what lies beyond is clipped.

    y = a (x / c)^t up to the centre c and 1 - (1 - a) ((1 - x) / (1 - c))^s beyond it, to the power
    of g; a gives both parts the same slope at c.

    Args:
        light: exposed, after the corrections of colour.
        raw: of each channel, before softplus (toe t >= .3, shoulder s >= .3, gamma g >= .1) and
            sigmoid (centre c).
    """
    toe = LEAST_TOE + jax.nn.softplus(raw[:, 0])
    shoulder = LEAST_SHOULDER + jax.nn.softplus(raw[:, 1])
    gamma = LEAST_GAMMA + jax.nn.softplus(raw[:, 2])
    centre = jax.nn.sigmoid(raw[:, 3])
    at_centre = shoulder * centre / (toe + centre * (shoulder - toe))
    x = unit_clip(light)
    low = at_centre * _power(x / centre, toe)
    high = 1.0 - (1.0 - at_centre) * _power((1.0 - x) / (1.0 - centre), shoulder)
    return _power(jnp.where(x <= centre, low, high), gamma, 0.0)


def _power(base: Float[Array, "..."], exponent: Float[Array, "..."], flat: float = FLAT):
    """Return base^exponent; 0, without a slope, up to `flat`."""
    on = base > flat
    return jnp.where(on, jnp.exp(exponent * jnp.log(jnp.where(on, base, 1.0))), 0.0)
