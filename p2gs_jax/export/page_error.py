"""What the page's Gaussians cost: their pictures against those of the run, by our renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.core.numerics import on_device
from p2gs_jax.formats.false_color import luminance
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render.capacity import RenderView
from p2gs_jax.types import Camera, Gaussians

# Stops are compared where the brightest channel is shown as this 8-bit level or more.
DARKEST_LEVEL = 1.0
# PSNR of equal pictures: the mean square error counts as this at least.
LEAST_ERROR = 1e-10


@dataclass(frozen=True)
class TruePicture:
    """A view as the run renders it.

    Attributes:
        name: of the view.
        camera: its camera.
        transform: how it was taken.
        linear: radiance.
        display: developed, in [0, 1].
    """

    name: str
    camera: Camera
    transform: DisplayTransform
    linear: Float32[np.ndarray, "h w 3"]
    display: Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class PageError:
    """Differences from the run's pictures of some views, each at its own exposure.

    Attributes:
        views: how many were compared.
        psnr_median: of developed pictures, dB.
        psnr_worst: of the worst view, dB.
        worst_view: its name.
        stops_median: of |log2| of the ratio of luminances, over pixels that are not black.
        stops_p99: 99th percentile of it.
        stops_max: largest.
    """

    views: int
    psnr_median: float
    psnr_worst: float
    worst_view: str
    stops_median: float
    stops_p99: float
    stops_max: float

    @property
    def plain(self) -> dict[str, Any]:
        """The attributes as plain values."""
        return asdict(self)


def true_picture(
    name: str,
    gaussians: Gaussians,
    camera: Camera,
    transform: DisplayTransform,
    render: RenderView,
) -> TruePicture:
    """Render a view of the run itself.

    Args:
        name: of the view.
        gaussians: of the run, all of them.
        camera: of the view.
        transform: how it was taken.
        render: of the run, from `make_renderer`.
    """
    linear = _linear(gaussians, camera, render)
    return TruePicture(name, camera, transform, linear, develop(linear, transform))


def page_error(
    gaussians: Gaussians, pictures: Sequence[TruePicture], render: RenderView
) -> PageError:
    """Compare pictures of other Gaussians with the true ones.

    Args:
        gaussians: as the page holds them.
        pictures: at least one.
        render: of the run, from `make_renderer`.
    """
    psnrs, stops = [], []
    for true in pictures:
        linear = _linear(gaussians, true.camera, render)
        shown = develop(linear, true.transform)
        square = np.mean((shown - true.display) ** 2, dtype=np.float64)
        psnrs.append(float(-10 * np.log10(max(square, LEAST_ERROR))))
        stops.append(_stops(linear, true))
    # A view may be black all over.
    apart = np.concatenate([np.zeros(1), *stops])
    worst = int(np.argmin(psnrs))
    return PageError(
        views=len(pictures),
        psnr_median=float(np.median(psnrs)),
        psnr_worst=psnrs[worst],
        worst_view=pictures[worst].name,
        stops_median=float(np.median(apart)),
        stops_p99=float(np.percentile(apart, 99)),
        stops_max=float(apart.max()),
    )


def _stops(linear: Float32[np.ndarray, "h w 3"], true: TruePicture) -> Float[np.ndarray, " p"]:
    lit = true.display.max(-1) >= DARKEST_LEVEL / 255
    ratio = np.maximum(luminance(linear[lit]), 1e-12) / np.maximum(
        luminance(true.linear[lit]), 1e-12
    )
    return np.abs(np.log2(ratio))


def _linear(g: Gaussians, camera: Camera, render: RenderView) -> Float32[np.ndarray, "h w 3"]:
    return np.asarray(render(g, on_device(np.ones(g.capacity), bool), camera).linear)
