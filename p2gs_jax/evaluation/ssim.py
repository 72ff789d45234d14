"""SSIM of two images under a mask, for losses and scores.

It is memory-bound. Its blurs are 11 shifted adds per axis, one colour channel at a time, so that
its maps stay in cache (all channels at once add 1 ms to a step of 7 ms on an H200). Its gradient is
explicit: it needs three blurs after the four blurs of the loss, and autodiff would need four
(BUILD_NOTES, "SSIM").
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from p2gs_jax.render.cores import cores, gather, this_core, total
from p2gs_jax.render.xla_cpu import materialize, opaque_true

Image = Float[Array, "h w 3"]

WINDOW, SIGMA = 11, 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2
_GAUSSIAN = np.exp(-((np.arange(WINDOW) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
# Weights along one axis of the window.
KERNEL = (_GAUSSIAN / _GAUSSIAN.sum()).tolist()


def _blur(maps: Float[Array, "m h w"], always: Bool[Array, ""]) -> Float[Array, "m h w"]:
    """Return the maps blurred along both axes, zero-padded as 3DGS does."""
    height, width = maps.shape[-2:]
    margin = WINDOW // 2
    padded = materialize(always, lambda: jnp.pad(maps, ((0, 0), (margin,) * 2, (margin,) * 2)))
    weights = list(enumerate(KERNEL))
    across = materialize(
        always, lambda: jnp.asarray(sum(k * padded[:, :, i : i + width] for i, k in weights))
    )
    return jnp.asarray(sum(k * across[:, i : i + height] for i, k in weights))


class _Parts(NamedTuple):
    """The terms of 1 - SSIM = A + B - A B; A and B vanish where both images agree.

    With the sum s and difference d of both images, blurred means m and variances v, SSIM is
    (1 - A)(1 - B), A = m(d)^2 / b1 and B = v(d) / b2 with SSIM's denominators b1 and b2. No large
    numbers cancel in this form, neither in the loss nor in its gradient, and small errors keep
    their digits (ours: BUILD_NOTES, "SSIM of differences").
    """

    s: Float[Array, "h w"]
    d: Float[Array, "h w"]
    ms: Float[Array, "h w"]
    md: Float[Array, "h w"]
    b1: Float[Array, "h w"]
    b2: Float[Array, "h w"]
    A: Float[Array, "h w"]
    B: Float[Array, "h w"]

    @property
    def unlike(self) -> Float[Array, "h w"]:
        """The map of 1 - SSIM."""
        return self.A + self.B - self.A * self.B


def _parts(x: Float[Array, "h w"], y: Float[Array, "h w"], always: Bool[Array, ""]) -> _Parts:
    s, d = x + y, x - y
    # Without `materialize` XLA blurs again for every later map (500x375 pixels: 10.1, not 6.8 ms).
    ms, md, mss, mdd = materialize(always, lambda: _blur(jnp.stack([s, d, s * s, d * d]), always))
    # The squared means (and variances) of both images sum to half of those of s and d.
    means = (ms * ms + md * md) / 2
    b1, b2 = means + C1, (mss + mdd) / 2 - means + C2
    return _Parts(s, d, ms, md, b1, b2, md * md / b1, (mdd - md * md) / b2)


def ssim_map(x: Float[Array, "c h w"], y: Float[Array, "c h w"]) -> Float[Array, "c h w"]:
    """Return the SSIM map of images in [0, 1] (Wang et al. 2004; 11x11 pixels, sigma 1.5)."""
    return 1 - _unlike_map(x, y)


def _unlike_map(x: Float[Array, "c h w"], y: Float[Array, "c h w"]) -> Float[Array, "c h w"]:
    def channel(pair):
        return _parts(pair[0], pair[1], opaque_true(pair[0][0, 0])).unlike

    return lax.map(channel, (x, y))


@jax.custom_vjp
def _masked_sum(
    x: Float[Array, "c h w"], y: Float[Array, "c h w"], mask: Float[Array, "h w"]
) -> Float[Array, ""]:
    """Return the sum of mask times 1 - SSIM; the gradient flows to `x` only."""
    return jnp.sum(_unlike_map(x, y) * mask)


def _masked_sum_fwd(x, y, mask):
    # Each core computes a strip of rows, with the rows around it that contribute to its gradient.
    height, reach = mask.shape[0], 2 * (WINDOW // 2) if cores() > 1 else 0
    rows = -(-height // cores())
    mine = slice(reach, reach + rows)

    def strip(a):
        if cores() == 1:
            return a
        beyond = (reach, cores() * rows - height + reach)
        a = jnp.pad(a, (*[(0, 0)] * (a.ndim - 2), beyond, (0, 0)))
        return lax.dynamic_slice_in_dim(a, this_core() * rows, rows + 2 * reach, -2)

    weights, always = strip(mask), opaque_true(mask[0, 0])

    def channel(pair):
        p = _parts(pair[0], pair[1], always)
        by_a, by_b = 1 - p.B, 1 - p.A
        # Derivatives by the blurred s and d (their sum), by blurred d^2, and by blurred s^2.
        d_m = by_a * (p.md * (2 - p.A) - p.ms * p.A) / p.b1
        d_m = d_m + by_b * (p.md * (p.B - 2) + p.ms * p.B) / p.b2
        d_dd = by_b * (1 - p.B / 2) / p.b2
        d_ss = -by_b * p.B / (2 * p.b2)
        back = _blur(weights * jnp.stack([d_m, d_dd, d_ss]), always)
        gradient = back[0] + 2 * p.d * back[1] + 2 * p.s * back[2]
        return jnp.sum((p.unlike * weights)[mine]), gradient[mine]

    sums, gradient = lax.map(channel, (strip(x), strip(y)))
    return total(jnp.sum(sums)), (gather(gradient, 1)[:, :height], mask)


def _masked_sum_bwd(residuals, v):
    gradient, mask = residuals
    return v * gradient, jnp.zeros_like(gradient), jnp.zeros_like(mask)


_masked_sum.defvjp(_masked_sum_fwd, _masked_sum_bwd)


def one_less_ssim(ldr: Image, target: Image, mask: Float[Array, "h w"]) -> Float[Array, ""]:
    """Return the mean of 1 - SSIM over valid pixels, 0 without any; invalid ones are made black."""
    x, y = ((a * mask[..., None]).transpose(2, 0, 1) for a in (ldr, target))
    return _masked_sum(x, y, mask) / jnp.maximum(3 * jnp.sum(mask), 1.0)


@jax.jit
def ssim(ldr: Image, target: Image, mask: Float[Array, "h w"]) -> Float[Array, ""]:
    """Return the mean SSIM over valid pixels, 1 without any; invalid ones are made black."""
    return 1 - one_less_ssim(ldr, target, mask)
