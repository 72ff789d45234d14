"""What is learned of the photographs, and how it maps them to the enhanced scene and back.

As its authors describe it: one curve for all photographs, to which a small network adds a bias for
each, clipped to [0, 1]; three orthonormal colour axes per photograph, along which the curve acts;
three numbers per photograph that shape a pseudo curve (a power, then an S), towards which the curve
is drawn. Ours: the network sees the histogram and the mean colour instead of attending to the
image and the camera's pose; the curve is interpolated, where theirs takes the entry below.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.luminance.axes import PARAMETERS, axes_of, spans
from p2gs_jax.photometry.luminance.statistics import STATISTICS

# Entries of a curve, as published.
ENTRIES = 255
# Width of the network (ours).
HIDDEN = 32
# What a raw unit stands for, so that one learning rate serves all (the authors have rates of 1e-3
# for the curve, 2e-4 for the axes and 1e-5 for the network).
AXES_UNIT, BIAS_UNIT = 0.2, 0.1
# Published: power 1 + 0.1 g, turning point 0.5 + 0.002 a, exponent 1 + 0.002 b.
POWER_UNIT, TURN_UNIT, BEND_UNIT = 0.1, 0.002, 0.002
DARKEST = 1e-3
# Least rise of a curve from one entry to the next where it is inverted.
LEAST_RISE = 1e-5


class Curves(eqx.Module):
    """How one photograph was taken, as Luminance-GS models it.

    Attributes:
        curve: from the photograph's coordinates to the enhanced ones, at even steps over [0, 1].
        axes: as rows.
        shape: of the pseudo curve: raw power, turning point and exponent.
    """

    curve: Float[Array, " k"]
    axes: Float[Array, "3 3"]
    shape: Float[Array, " 3"]


class Luminance(eqx.Module):
    """The parameters of all training views.

    Attributes:
        curve: of all photographs.
        hidden: weights from statistics to the hidden layer.
        hidden_bias: of the hidden layer.
        out: weights from there to the curve's biases and the pseudo curve's shape.
        out_bias: of these.
        axes: raw, of each view.
        statistics: of each photograph; not learned.
    """

    curve: Float[Array, " k"]
    hidden: Float[Array, "s n"]
    hidden_bias: Float[Array, " n"]
    out: Float[Array, "n o"]
    out_bias: Float[Array, " o"]
    axes: Float[Array, "v 5"]
    statistics: Float[Array, "v s"]

    def view(self, row: Int[Array, ""] | int) -> Curves:
        """Return what holds for a training view."""
        curve, shape = self._predicted(self.statistics[row])
        return Curves(curve, axes_of(AXES_UNIT * jnp.asarray(self.axes[row])), shape)

    def mean(self) -> Curves:
        """Return the mean over the training views: of curves, and of raw axes."""
        curves, shapes = self._predicted(self.statistics)
        axes = axes_of(AXES_UNIT * jnp.asarray(self.axes).mean(0))
        return Curves(curves.mean(0), axes, shapes.mean(0))

    def _predicted(
        self, statistics: Float[Array, "*v s"]
    ) -> tuple[Float[Array, "*v k"], Float[Array, "*v 3"]]:
        """Return the curves of photographs and the shapes of their pseudo curves."""
        seen = lax.stop_gradient(jnp.asarray(statistics))
        inner = jnp.tanh(seen @ self.hidden + self.hidden_bias)
        found = inner @ self.out + self.out_bias
        return jnp.clip(self.curve + BIAS_UNIT * found[..., :ENTRIES], 0, 1), found[..., ENTRIES:]


def identity(views: int) -> Luminance:
    """Return parameters that change nothing; the statistics are zero until they are filled in.

    Args:
        views: how many training views there are.
    """
    # Drawn once for all fits: a network of zeros would never learn.
    weights = generator(0, Stream.NETWORK).normal(0, STATISTICS**-0.5, (STATISTICS, HIDDEN))
    outputs = ENTRIES + 3
    return Luminance(
        on_device(np.linspace(0.0, 1.0, ENTRIES)),
        on_device(weights),
        on_device(np.zeros(HIDDEN)),
        on_device(np.zeros((HIDDEN, outputs))),
        on_device(np.zeros(outputs)),
        on_device(np.zeros((views, PARAMETERS))),
        on_device(np.zeros((views, STATISTICS))),
    )


def enhanced(ldr: Float[Array, "*p 3"], view: Curves) -> Float[Array, "*p 3"]:
    """Return the enhanced display values that a photograph stands for.

    Args:
        ldr: of the photograph.
        view: how it was taken.
    """
    return _along_axes(ldr, view.axes, lambda t: _looked_up(t, view.curve))


def as_photographed(ldr: Float[Array, "*p 3"], view: Curves) -> Float[Array, "*p 3"]:
    """Return how a photograph shows enhanced display values: about the inverse of `enhanced`.

    Where the curve falls it counts as level; level pieces return their lower end. The authors
    splat a second colour per Gaussian instead.

    Args:
        ldr: enhanced.
        view: how it was taken.
    """
    count = view.curve.shape[0]
    even = jnp.linspace(0.0, 1.0, count, dtype=view.curve.dtype)
    rise = LEAST_RISE * (count - 1)
    rising = (lax.cummax(view.curve) + rise * even) / (1.0 + rise)
    return _along_axes(ldr, view.axes, lambda t: jnp.interp(t, rising, even))


def _along_axes(ldr, axes, change):
    low, high = spans(axes)
    along = (ldr @ axes.T - low) / (high - low)
    return (change(along) * (high - low) + low) @ axes


def _looked_up(t: Float[Array, "*p"], curve: Float[Array, " k"]) -> Float[Array, "*p"]:
    count = curve.shape[0]
    at = jnp.clip(t, 0.0, 1.0) * (count - 1)
    below = jnp.clip(jnp.floor(at), 0, count - 2).astype(jnp.int32)
    share = at - below
    return (1 - share) * curve[below] + share * curve[below + 1]


def pseudo_curve(shape: Float[Array, " 3"]) -> Float[Array, " k"]:
    """Return the curve that a power and an S make, as published; about the identity at zero.

    Args:
        shape: raw power, turning point and exponent.
    """
    x = jnp.linspace(0.0, 1.0, ENTRIES, dtype=shape.dtype)
    x = jnp.clip(x, DARKEST, 1.0) ** (1.0 + POWER_UNIT * shape[0])
    turn, bend = 0.5 + TURN_UNIT * shape[1], 1.0 + BEND_UNIT * shape[2]
    below = jnp.clip(x / turn, 0.0, 1.0 - DARKEST)
    above = jnp.clip((x - turn) / (1.0 - turn), DARKEST, 1.0 - DARKEST)
    return jnp.where(
        x <= turn, turn - turn * (1.0 - below) ** bend, turn + (1.0 - turn) * above**bend
    )
