"""Corrections of display values per view, as published baselines learn them beside the splats.

`affine`: a 3x4 colour matrix per view, with results clipped to [0, 1] (the 3DGS code's exposure
compensation). `bilateral`: a grid of such matrices over the image and luminance (bilateral-guided
radiance fields). `curve`: one increasing curve per view for all channels. Their parameters are
deviations: zeros change no value from 0 to 1. `ppisp` (`ppisp.py`) replaces the tone curve and also
has parameters of cameras. `luminance` (`luminance.py`) maps photographs to an enhanced scene, as
Luminance-GS does; its inverse maps renders to photographs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from p2gs_jax.config import Appearance
from p2gs_jax.core.numerics import LN2, on_device, unit_clip
from p2gs_jax.photometry import luminance, ppisp
from p2gs_jax.photometry.luminance import Curves, Luminance
from p2gs_jax.photometry.ppisp import OneView, Ppisp
from p2gs_jax.types import LUMINANCE, Array, Capture, Params


@runtime_checkable
class Formation(Protocol):
    """A custom image formation that replaces the tone curve and corrections.

    It is a pytree (an `equinox.Module`) whose arrays are its initial parameters. They are common to
    all views and learned at the rate `OptimizerConfig.appearance`.
    """

    def apply(self, radiance: Float[Array, "h w 3"], capture: Capture) -> Float[Array, "h w 3"]:
        """Return display values, not clamped, of linear radiance under a view's exposure."""
        ...


# Corrections of all training views: a row for each, or parameters of a model.
Corrections = Float[Array, "v ..."] | Ppisp | Luminance | Formation
Correction = Float[Array, "..."] | OneView | Curves | Formation  # of one view

# Luminance levels, rows and columns of a bilateral grid, as published.
GRID = (8, 16, 16)
CURVE_PIECES = 16


def identity(kind: Appearance, cameras: Sequence[str]) -> Corrections:
    """Return parameters that change no value from 0 to 1; `cameras` has one per view."""
    if kind == "ppisp":
        return ppisp.identity(cameras)
    if kind == "luminance":
        return luminance.identity(len(cameras))
    shapes = {"affine": (3, 4), "bilateral": (12, *GRID), "curve": (CURVE_PIECES,)}
    return on_device(np.zeros((len(cameras), *shapes[kind])))


def correction_of(appearance: Corrections | None, row: Int[Array, ""] | int) -> Correction | None:
    """Return the correction of the training view in a row of `Photometry`, or None."""
    if isinstance(appearance, Ppisp | Luminance):
        return appearance.view(row)
    if isinstance(appearance, Formation):
        return appearance
    return None if appearance is None else appearance[row]


def mean_correction(appearance: Corrections | None, camera: str | None = None) -> Correction | None:
    """Return the mean over the training views, for other views; PPISP's depends on their camera."""
    if isinstance(appearance, Ppisp):
        return appearance.mean(camera)
    if isinstance(appearance, Luminance):
        return appearance.mean()
    if isinstance(appearance, Formation):
        return appearance
    return None if appearance is None else appearance.mean(axis=0)


def exposures_apart(params: Params) -> Params:
    """Return parameters with PPISP's exposures moved to `Photometry`, as for other models."""
    if not isinstance(params.appearance, Ppisp):
        return params
    stops, photometry = params.appearance.exposures, params.photometry
    raw = photometry.raw_exposures + LN2 * stops
    if photometry.parameterization == "linear":
        raw = photometry.exposures * 2.0**stops
    return dataclasses.replace(
        params,
        photometry=dataclasses.replace(photometry, raw_exposures=raw),
        appearance=dataclasses.replace(params.appearance, exposures=0.0 * stops),
    )


def without_place(correction: Correction | None, kind: Appearance | None) -> Correction | None:
    """Return the part of a correction that does not depend on the position in the image."""
    if isinstance(correction, OneView):
        return dataclasses.replace(correction, vignetting=None)
    return None if kind == "bilateral" else correction


def corrected(
    ldr: Float[Array, "h w 3"], parameters: Float[Array, "..."] | OneView | Curves, kind: Appearance
) -> Float[Array, "h w 3"]:
    """Return corrected display values of a view; for `ppisp`, `ldr` is radiance."""
    if isinstance(parameters, OneView):
        return ppisp.applied(ldr, parameters)
    if isinstance(parameters, Curves):
        # Gradients reach the Gaussians only; the curves are learned from photographs.
        return luminance.as_photographed(ldr, lax.stop_gradient(parameters))
    if kind == "affine":
        return unit_clip(ldr + ldr @ parameters[:, :3].T + parameters[:, 3])
    return _curve(ldr, parameters) if kind == "curve" else _bilateral(ldr, parameters)


def _curve(ldr: Float[Array, "h w 3"], raw: Float[Array, " k"]) -> Float[Array, "h w 3"]:
    """Return values of a piecewise linear curve with slopes exp(raw) > 0, extended above 1."""
    count = raw.shape[0]
    slopes = jnp.exp(raw)
    starts = jnp.concatenate([jnp.zeros(1), jnp.cumsum(slopes)[:-1]]) / count
    piece = jnp.clip(jnp.floor(ldr * count), 0, count - 1).astype(jnp.int32)
    return starts[piece] + (ldr - piece / count) * slopes[piece]


def _bilateral(ldr: Float[Array, "h w 3"], grid: Float[Array, "12 d y x"]) -> Float[Array, "h w 3"]:
    """Return values corrected by a grid, sliced by dense products with hat functions."""
    height, width, _ = ldr.shape
    levels, rows, columns = grid.shape[1:]
    # The order y, x, level, coefficient takes a third of the time of the grid's order.
    cells = grid.transpose(2, 3, 1, 0).reshape(rows, -1)
    up = (jnp.asarray(_hats(height, rows), ldr.dtype) @ cells).reshape(height, columns, -1)
    up = jnp.einsum("wx,hxk->hwk", jnp.asarray(_hats(width, columns), ldr.dtype), up)
    guide = jnp.clip(ldr @ jnp.asarray(LUMINANCE, ldr.dtype), 0.0, 1.0) * (levels - 1)
    hats = jnp.maximum(1.0 - jnp.abs(guide[..., None] - jnp.arange(levels)), 0.0)
    matrix = jnp.einsum("hwd,hwdk->hwk", hats, up.reshape(height, width, levels, 12))
    matrix = matrix.reshape(height, width, 3, 4)
    return ldr + jnp.einsum("hwij,hwj->hwi", matrix[..., :3], ldr) + matrix[..., 3]


def _hats(pixels: int, cells: int) -> np.ndarray:
    """Return linear interpolation weights from cells to pixels, corners aligned."""
    at = np.linspace(0.0, cells - 1.0, pixels)[:, None]
    return np.maximum(1.0 - np.abs(at - np.arange(cells)), 0.0)


def regularisation(parameters: Corrections, kind: Appearance) -> Float[Array, ""] | None:
    """Return the penalty on differences of grid cells, or PPISP's terms; None: there are none."""
    if isinstance(parameters, Ppisp):
        return ppisp.regularisation_of(parameters)
    if isinstance(parameters, Luminance | Formation) or kind != "bilateral":
        return None
    return sum((jnp.mean(jnp.diff(parameters, axis=k) ** 2) for k in (2, 3, 4)), jnp.zeros(()))
