"""Luminance-GS (Cui, Chu and Harada, CVPR 2025): a colour matrix and a curve per photograph.

They map photographs to the enhanced scene and back. The published method has one curve for all
photographs; a small network adds a bias per photograph, and the sum is clipped to [0, 1]. The curve
acts along three orthonormal colour axes per photograph. Three numbers per photograph shape a pseudo
curve (a power, then an S), to which the loss pulls the curve. The network's input here is the
histogram and the mean colour; theirs is the image and the camera's pose. The curve is interpolated;
theirs takes the entry below. docs/baselines.md lists the differences.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.types import Array

ENTRIES = 255  # entries of a curve, as published
HIDDEN = 32  # width of the network (ours)
# Number of steps of the cumulative histogram; number of the network's inputs.
LEVELS = 32
STATISTICS = LEVELS + 3
AXES = 5  # parameters of the axes
# Factors on raw parameters, so that one learning rate suits all (the published rates are 1e-3 for
# the curve, 2e-4 for the axes and 1e-5 for the network).
AXES_UNIT, BIAS_UNIT = 0.2, 0.1
# Published: power 1 + 0.1 g, turning point 0.5 + 0.002 a, exponent 1 + 0.002 b.
POWER_UNIT, TURN_UNIT, BEND_UNIT = 0.1, 0.002, 0.002
DARKEST = 1e-3  # lower bound of bases of powers, whose gradient at 0 may be infinite
LEAST_RISE = 1e-5  # least rise of a curve from one entry to the next where it is inverted


class Curves(eqx.Module):
    """Parameters of one photograph in Luminance-GS."""

    # Enhanced coordinates at even steps of the photograph's coordinates over [0, 1].
    curve: Float[Array, " k"]
    axes: Float[Array, "3 3"]  # colour axes as rows
    shape: Float[Array, " 3"]  # raw power, turning point and exponent of the pseudo curve


class Luminance(eqx.Module):
    """The parameters of all training views."""

    curve: Float[Array, " k"]  # curve of all photographs
    hidden: Float[Array, "s n"]  # weights from statistics to the hidden layer
    hidden_bias: Float[Array, " n"]
    out: Float[Array, "n o"]  # weights to the curve's biases and the pseudo curve's shape
    out_bias: Float[Array, " o"]
    axes: Float[Array, "v 5"]  # raw axes of each view
    statistics: Float[Array, "v s"]  # statistics of each photograph; not learned

    def view(self, row: Int[Array, ""] | int) -> Curves:
        """Return the parameters of a training view."""
        curve, shape = self._predicted(self.statistics[row])
        return Curves(curve, axes_of(AXES_UNIT * jnp.asarray(self.axes[row])), shape)

    def mean(self) -> Curves:
        """Return means over the training views: of curves, raw axes and raw shapes."""
        curves, shapes = self._predicted(self.statistics)
        axes = axes_of(AXES_UNIT * jnp.asarray(self.axes).mean(0))
        return Curves(curves.mean(0), axes, shapes.mean(0))

    def _predicted(
        self, statistics: Float[Array, "*v s"]
    ) -> tuple[Float[Array, "*v k"], Float[Array, "*v 3"]]:
        """Return the curves of photographs and the shapes of their pseudo curves."""
        inputs = lax.stop_gradient(jnp.asarray(statistics))
        inner = jnp.tanh(inputs @ self.hidden + self.hidden_bias)
        found = inner @ self.out + self.out_bias
        return jnp.clip(self.curve + BIAS_UNIT * found[..., :ENTRIES], 0, 1), found[..., ENTRIES:]


def identity(views: int) -> Luminance:
    """Return parameters that change nothing; the statistics are zero until they are set."""
    # Random weights, the same in all fits: a network of zeros would never learn.
    weights = generator(0, Stream.NETWORK).normal(0, STATISTICS**-0.5, (STATISTICS, HIDDEN))
    outputs = ENTRIES + 3
    shapes = (HIDDEN, (HIDDEN, outputs), outputs, (views, AXES), (views, STATISTICS))
    zeros = map(np.zeros, shapes)
    return Luminance(*map(on_device, (np.linspace(0.0, 1.0, ENTRIES), weights, *zeros)))


def axes_of(raw: Float[Array, " 5"]) -> Float[Array, "3 3"]:
    """Return three orthonormal axes as rows, as published: the identity at zero.

    The first three numbers are added to (1, 0, 0), the others to the green and blue parts (1, 0) of
    the second axis. Its red part makes it orthogonal to the first.
    """
    first = raw[:3] + jnp.array([1.0, 0.0, 0.0], raw.dtype)
    green, blue = raw[3] + 1.0, raw[4]
    red = -(green * first[1] + blue * first[2]) / first[0]
    second = jnp.stack([red, green, blue])
    rows = jnp.stack([first, second, jnp.cross(first, second)])
    return rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)


def enhanced(ldr: Float[Array, "*p 3"], view: Curves) -> Float[Array, "*p 3"]:
    """Return the enhanced display values of a photograph."""

    def looked_up(t: Float[Array, "*p"]) -> Float[Array, "*p"]:
        at = jnp.clip(t, 0.0, 1.0) * (view.curve.shape[0] - 1)
        below = jnp.clip(jnp.floor(at), 0, view.curve.shape[0] - 2).astype(jnp.int32)
        share = at - below
        return (1 - share) * view.curve[below] + share * view.curve[below + 1]

    return _along_axes(ldr, view.axes, looked_up)


def as_photographed(ldr: Float[Array, "*p 3"], view: Curves) -> Float[Array, "*p 3"]:
    """Return display values of a photograph from enhanced ones: an approximate inverse.

    Decreasing pieces of the curve count as constant. A constant piece returns the position in it
    that is nearest to its value. The published method splats a second colour per Gaussian instead.
    """
    count = view.curve.shape[0]
    even = jnp.linspace(0.0, 1.0, count, dtype=view.curve.dtype)
    rise = LEAST_RISE * (count - 1)
    rising = (lax.cummax(view.curve) + rise * even) / (1.0 + rise)
    return _along_axes(ldr, view.axes, lambda t: jnp.interp(t, rising, even))


def _along_axes(ldr, axes, change):
    """Return colours after `change` of their axis coordinates, which are scaled to [0, 1]."""
    # The least and the largest coordinate of colours in [0, 1] along each axis.
    low, high = jnp.minimum(axes, 0).sum(-1), jnp.maximum(axes, 0).sum(-1)
    along = (ldr @ axes.T - low) / (high - low)
    return (change(along) * (high - low) + low) @ axes


def pseudo_curve(shape: Float[Array, " 3"]) -> Float[Array, " k"]:
    """Return the published curve of a power and an S; approximately the identity at zero."""
    x = jnp.linspace(0.0, 1.0, ENTRIES, dtype=shape.dtype)
    x = jnp.clip(x, DARKEST, 1.0) ** (1.0 + POWER_UNIT * shape[0])
    turn, bend = 0.5 + TURN_UNIT * shape[1], 1.0 + BEND_UNIT * shape[2]
    below = jnp.clip(x / turn, 0.0, 1.0 - DARKEST)
    above = jnp.clip((x - turn) / (1.0 - turn), DARKEST, 1.0 - DARKEST)
    return jnp.where(
        x <= turn, turn - turn * (1.0 - below) ** bend, turn + (1.0 - turn) * above**bend
    )


def cumulative(
    grey: Float[Array, " p"], weight: Float[Array, " p"], steps: int
) -> Float[Array, " s"]:
    """Return the shares of greys up to k / (steps - 1); without weight, k / (steps - 1)."""
    bins = jnp.clip(jnp.ceil(grey * (steps - 1)), 0, steps - 1).astype(jnp.int32)
    counts = jnp.zeros(steps, grey.dtype).at[bins].add(weight)
    total = counts.sum()
    even = jnp.linspace(0.0, 1.0, steps, dtype=grey.dtype)
    return jnp.where(total > 0, jnp.cumsum(counts) / jnp.maximum(total, 1e-9), even)


def statistics_of(
    photograph: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, " s"]:
    """Return cumulative histogram and mean colour of every fourth pixel along both axes."""
    colors, weight = photograph[::4, ::4].reshape(-1, 3), mask[::4, ::4].reshape(-1)
    mean = (weight[:, None] * colors).sum(0) / jnp.maximum(weight.sum(), 1.0)
    return jnp.concatenate([cumulative(colors.mean(-1), weight, LEVELS), mean])
