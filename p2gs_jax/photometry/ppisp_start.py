"""Solved photometry in the parameters of PPISP, from which its trainers may start.

Exposures, vignetting and white balance of greys carry over; a response of four numbers is fitted to
the tone curve, and the difference is measured. PPISP's light is 1 where a photograph saturates, and
its mean exposure is 0 stops, to which its regularisation pulls it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.photometry import ppisp
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.photometry.formation import camera_rows, inverse_tone_map

# Display values at which curves are compared: 8-bit codes 1 to 255, for three channels.
VALUES = np.repeat(np.arange(1, 256, dtype=np.float64)[:, None] / 255, 3, 1)
# A fit has several minima, and starts from the best of these responses.
STARTS = np.stack(np.meshgrid(*[np.linspace(-3, 3, 7)] * 4), -1).reshape(-1, 4)


class Start(NamedTuple):
    """Initial parameters, and their difference from the solved photometry."""

    parameters: ppisp.Ppisp
    radiance_ev: float  # PPISP's radiance is ours times 2 to this power
    # mean and largest difference, 8-bit codes, between PPISP's response to greys and every camera's
    # tone curve at the mean gamma of its views
    codes: Float[np.ndarray, "c 2"]


def start_of(
    cfg: PhotometryConfig,
    cameras: Sequence[str],
    exposures: Float[np.ndarray, " v"],
    gammas: Float[np.ndarray, " v"],
    balances: Float[np.ndarray, "v 3"],
    sizes: Mapping[str, tuple[int, int]],
) -> Start:
    """Return PPISP's parameters of some views.

    `cameras` and `exposures` (factors on radiance) are by view, `balances` are log factors on the
    channels, and `sizes` are width and height of every camera's photographs, pixels.
    """
    plain = ppisp.identity(cameras)
    rows = camera_rows(plain.names, cfg) or (None,) * len(plain.names)
    of_view, responses, vignettings, whites, codes = np.array(plain.cameras), [], [], [], []
    for k, (name, row) in enumerate(zip(plain.names, rows, strict=True)):
        exposed = inverse_tone_map(VALUES, float(gammas[of_view == k].mean()), cfg, row)
        # The light of white; channels with different responses share their mean.
        whites.append(np.exp(np.log(exposed[-1]).mean()))
        response, off = _response(exposed / whites[-1])
        responses.append(response)
        codes.append((off.mean(), off.max()))
        darker = DisplayTransform(1.0, 1.0, cfg, camera=row).vignetting
        vignettings.append(_vignetting(darker, *sizes[name]))
    # PPISP keeps R + G + B: the factors of a grey have the sum 3, and the exposure takes the rest.
    factors = np.exp(balances)
    sums = factors.sum(1, keepdims=True) / 3
    stops = np.log2(exposures * sums[:, 0] / np.array(whites)[of_view])
    neutral = (factors / sums)[:, :2] / 3 - 1 / 3
    colors = np.pad(neutral @ np.linalg.inv(ppisp.PRECONDITIONERS[3]), ((0, 0), (6, 0)))
    learned = (stops - stops.mean(), colors, np.array(responses), np.array(vignettings))
    found = ppisp.Ppisp(*map(on_device, learned), names=plain.names, cameras=plain.cameras)
    return Start(found, float(stops.mean()), np.array(codes))


def _response(light: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, ...]:
    """Return responses (3, 4) that map light to `VALUES`, and absolute errors (3, n) in codes."""
    respond, found = jax.jit(ppisp.respond), []

    def off(raw: np.ndarray, column: np.ndarray) -> np.ndarray:
        return np.asarray(respond(column, raw.reshape(-1, 4)), np.float64) - VALUES[:, :1]

    for channel in light.T:
        start = STARTS[np.square(off(STARTS, channel[:, None])).sum(0).argmin()]
        # The step suits float32. Far parameters are excluded: they have no gradient in training.
        how: Any = {"diff_step": 1e-3, "bounds": (-6, 6), "args": (channel[:, None],)}
        best = least_squares(lambda *a: off(*a)[:, 0], start, **how)
        found.append((best.x, 255 * np.abs(best.fun)))
    return tuple(map(np.array, zip(*found, strict=True)))


def _vignetting(rows: Sequence[Sequence[float]], width: int, height: int) -> np.ndarray:
    """Return the centre and the coefficients of r^2, r^4, r^6 of each channel, (3, 5).

    `rows` are our coefficients for all channels or for each. Our radius is 1 in the corners,
    PPISP's is in units of the longer side.
    """
    out, share = np.zeros((3, ppisp.COEFFICIENTS)), np.linspace(0, 1)[:, None]
    squared = share * (width**2 + height**2) / (2 * max(width, height)) ** 2
    for channel in range(3 if rows else 0):
        row = np.array(rows[channel if len(rows) > 1 else 0])
        falloff = np.exp(share ** np.arange(1, len(row) + 1) @ row)
        out[channel, 2:] = np.linalg.lstsq(squared ** np.arange(1, 4), falloff - 1)[0]
    return out
