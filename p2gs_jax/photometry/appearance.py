"""Corrections of display values per view, as published baselines learn them beside the splats.

`affine`: a 3x4 colour matrix per view (the 3DGS code's exposure compensation). `bilateral`: a grid
of such matrices over the image and luminance (bilateral-guided radiance fields). `curve`: one
rising curve per view for all channels (in the manner of Luminance-GS). Their parameters are
deviations: zeros change nothing. `ppisp` (`ppisp.py`) takes the place of the tone curve and has
parameters of cameras as well. `luminance` (`luminance.py`) maps photographs to an enhanced scene,
as Luminance-GS does; renders are shown through its inverse.
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
from p2gs_jax.core.numerics import LN2, on_device
from p2gs_jax.photometry import luminance, ppisp
from p2gs_jax.photometry.luminance import Curves, Luminance
from p2gs_jax.photometry.ppisp import OneView, Ppisp
from p2gs_jax.types import LUMINANCE, Array, Capture, Params


@runtime_checkable
class Formation(Protocol):
    """An image formation of yours, in the place of the tone curve and of corrections.

    A pytree (an `equinox.Module`) whose arrays are its initial parameters: they are learned at the
    rate `OptimizerConfig.appearance`, the same for all views.
    """

    def apply(self, radiance: Float[Array, "h w 3"], capture: Capture) -> Float[Array, "h w 3"]:
        """Return display values, not clamped, of linear radiance under a view's exposure."""
        ...


# Of all training views: a row for each, or what PPISP, Luminance-GS or a formation learns.
Corrections = Float[Array, "v ..."] | Ppisp | Luminance | Formation
Correction = Float[Array, "..."] | OneView | Curves | Formation  # of one view

# Luminance levels, rows and columns of a bilateral grid, as its authors use.
GRID = (8, 16, 16)
CURVE_KNOTS = 16


def identity(kind: Appearance, cameras: Sequence[str]) -> Corrections:
    """Return parameters that change nothing; `cameras` is the camera of every training view."""
    if kind == "ppisp":
        return ppisp.identity(cameras)
    if kind == "luminance":
        return luminance.identity(len(cameras))
    shapes = {"affine": (3, 4), "bilateral": (12, *GRID), "curve": (CURVE_KNOTS,)}
    return on_device(np.zeros((len(cameras), *shapes[kind])))


def correction_of(appearance: Corrections | None, row: Int[Array, ""] | int) -> Correction | None:
    """Return the correction of the training view in a row of `Photometry`, or None."""
    if isinstance(appearance, Ppisp | Luminance):
        return appearance.view(row)
    if isinstance(appearance, Formation):
        return appearance
    return None if appearance is None else appearance[row]


def mean_correction(appearance: Corrections | None, camera: str | None = None) -> Correction | None:
    """Return the mean over the training views, for a view of a camera that has none of its own."""
    if isinstance(appearance, Ppisp):
        return appearance.mean(camera)
    if isinstance(appearance, Luminance):
        return appearance.mean()
    if isinstance(appearance, Formation):
        return appearance
    return None if appearance is None else appearance.mean(axis=0)


def exposures_apart(params: Params) -> Params:
    """Return a finished fit with PPISP's exposures in `Photometry`, as all others have theirs."""
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
    """Return what of a correction does not depend on the position in the image."""
    if isinstance(correction, OneView):
        return dataclasses.replace(correction, vignetting=None)
    return None if kind == "bilateral" else correction


def corrected(
    ldr: Float[Array, "h w 3"], parameters: Float[Array, "..."] | OneView | Curves, kind: Appearance
) -> Float[Array, "h w 3"]:
    """Return display values as one view shows them; `ldr` is rendered, for `ppisp` radiance."""
    if isinstance(parameters, OneView):
        return ppisp.applied(ldr, parameters)
    if isinstance(parameters, Curves):
        # The Gaussians learn through it; it is learned from photographs alone.
        return luminance.as_photographed(ldr, lax.stop_gradient(parameters))
    if kind == "affine":
        return ldr + ldr @ parameters[:, :3].T + parameters[:, 3]
    return _curve(ldr, parameters) if kind == "curve" else _bilateral(ldr, parameters)


def _curve(ldr: Float[Array, "h w 3"], raw: Float[Array, " k"]) -> Float[Array, "h w 3"]:
    """Piecewise linear with slopes exp(raw): always rising; the last piece goes on above 1."""
    count = raw.shape[0]
    slopes = jnp.exp(raw)
    starts = jnp.concatenate([jnp.zeros(1), jnp.cumsum(slopes)[:-1]]) / count
    place = jnp.clip(jnp.floor(ldr * count), 0, count - 1).astype(jnp.int32)
    return starts[place] + (ldr - place / count) * slopes[place]


def _bilateral(ldr: Float[Array, "h w 3"], grid: Float[Array, "12 d y x"]) -> Float[Array, "h w 3"]:
    """Slice by matrix products and hat functions: dense, so that its gradient is as well."""
    height, width, _ = ldr.shape
    levels, rows, columns = grid.shape[1:]
    # y, x, level, coefficient: a third of the time of the grid's own order.
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
    """Return the mean squared difference of neighbouring cells of grids, PPISP's own, or None."""
    if isinstance(parameters, Ppisp):
        return ppisp.regularisation_of(parameters)
    if isinstance(parameters, Luminance | Formation) or kind != "bilateral":
        return None
    return sum((jnp.mean(jnp.diff(parameters, axis=k) ** 2) for k in (2, 3, 4)), jnp.zeros(()))
