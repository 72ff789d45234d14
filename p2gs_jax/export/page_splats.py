"""The Gaussians of a page: all visible ones, or the ones of largest weight; and their error."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.formats.false_color import luminance
from p2gs_jax.formats.packed import Packed, pack, unpack
from p2gs_jax.gaussians.posed import chosen
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render import render_linear
from p2gs_jax.render.capacity import PICTURES, RenderView, bucket, count_needed, until_it_fits
from p2gs_jax.render.harmonics import C0, coefficient_count, degree_of
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera, Gaussians

# A page with a smaller share of the Gaussians is refused.
LEAST_SHARE = 0.02
# Attempts to fit into a page, and the share of its room at which each attempt aims.
ATTEMPTS, MARGIN = 6, 0.985
# Stops are compared for pixels whose brightest channel has at least this 8-bit level.
DARKEST_LEVEL = 1.0
# The least mean squared error: the PSNR of equal pictures is 100 dB.
LEAST_ERROR = 1e-10


class RunPicture(NamedTuple):
    """A view rendered with all Gaussians of the run: radiance and display values."""

    name: str
    camera: Camera
    transform: DisplayTransform
    linear: Float32[np.ndarray, "h w 3"]
    display: Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class PageError:
    """Differences from the run's pictures of some views, each at the view's exposure.

    PSNR (dB) compares developed pictures. Stops are |log2| of the ratio of luminances of pixels
    that are not black: median, 99th percentile, largest.
    """

    views: int
    psnr_median: float
    psnr_worst: float
    worst_view: str
    stops_median: float
    stops_p99: float
    stops_max: float


@dataclass(frozen=True)
class PageSplats:
    """The packed Gaussians of a page, with their error against the run.

    The run has `total` Gaussians with harmonics of degree `degree`. No camera shows the `unseen`
    ones, so the page leaves them out.
    """

    packed: Packed
    error: PageError
    total: int
    degree: int
    unseen: int

    @property
    def dropped(self) -> int:
        """Number of visible Gaussians that are left out."""
        return self.total - self.unseen - self.packed.count

    @property
    def kept_degree(self) -> int:
        """Degree of the page's harmonics."""
        return degree_of(self.packed.coefficients)

    @property
    def whole(self) -> bool:
        """Whether all visible Gaussians and their harmonics are in the page."""
        return self.dropped == 0 and self.kept_degree == self.degree


def fit_into(
    room: int,
    gaussians: Gaussians,
    cfg: RenderConfig,
    cameras: Sequence[Camera],
    judge: Callable[[Gaussians], PageError],
    say: Callable[[str], None] = lambda text: None,
) -> PageSplats:
    """Return the Gaussians of a page, packed to at most `room` bytes.

    If not all fit, each degree of harmonics is tried with as many Gaussians as fit, in the order of
    their weights in the pictures of `cameras`. The result has the highest median PSNR. `judge`
    returns the error of Gaussians. Raises UserError: hardly any Gaussian fits, or none is visible.
    """
    drawn = ever_drawn(gaussians, cfg)
    unseen, degree = int((~drawn).sum()), degree_of(gaussians.sh.shape[1])
    whole = chosen(gaussians, drawn)
    if whole.capacity == 0:
        raise UserError("the run has no visible Gaussian.", fix="fit it for longer")

    def judged(packed: Packed) -> PageSplats:
        return PageSplats(packed, judge(unpack(packed)), gaussians.capacity, degree, unseen)

    say("Packing")
    packed = pack(whole)
    if len(packed.data) <= room:
        return judged(packed)
    say("Weighing Gaussians")
    order = np.argsort(-weights(whole, cameras, cfg), kind="stable")
    found = []
    for kept in range(degree, -1, -1):
        say(f"Trying harmonics of degree {kept}")
        cut = replace(whole, sh=whole.sh[:, : coefficient_count(kept)])
        smaller = _largest_that_fits(room, cut, order)
        if smaller is not None:
            found.append(judged(smaller))
    if not found:
        why = f"less than {LEAST_SHARE:.0%} of {whole.capacity} Gaussians would fit into the page."
        raise UserError(why, fix="allow a larger page with --size-mb, or embed fewer --photographs")
    return max(found, key=lambda splats: splats.error.psnr_median)


def ever_drawn(gaussians: Gaussians, cfg: RenderConfig) -> Bool[np.ndarray, " n"]:
    """Return a mask of Gaussians that are finite and more opaque than the cutoff."""
    finite = np.ones(gaussians.capacity, bool)
    for value in (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.sh):
        finite &= np.isfinite(np.asarray(value).reshape(gaussians.capacity, -1)).all(1)
    logits = np.asarray(gaussians.opacity_logits, np.float64)
    with np.errstate(invalid="ignore"):
        return finite & (-np.logaddexp(0, -logits) > np.log(cfg.alpha_cutoff))


def weights(
    gaussians: Gaussians, cameras: Sequence[Camera], cfg: RenderConfig
) -> Float[np.ndarray, " n"]:
    """Return the sum of each Gaussian's blending weights over the pixels of all `cameras`.

    At radiance 1 it is the derivative of the sum of all pixels by the Gaussian's log radiance.
    """
    plain = replace(cfg, radiance="exp")
    alive = gaussians.all_alive
    sh = on_device(np.zeros((gaussians.capacity, 1, 3)))
    needed = max(int(count_needed(gaussians, alive, camera, cfg=plain)) for camera in cameras)
    capacity, total = bucket(needed, PICTURES), np.zeros(gaussians.capacity)

    @functools.partial(jax.jit, static_argnames="capacity", compiler_options=compiler_options())
    def gradient(g: Gaussians, camera: Camera, *, capacity: int) -> tuple[Array, Array, Array]:
        def light(sh):
            shown = replace(g, sh=sh)
            result = render_linear(shown, alive, camera, plain, capacity, with_depth=False)
            return jnp.sum(result.linear[..., 0]), result

        slope, result = jax.grad(light, has_aux=True)(g.sh)
        return slope[:, 0, 0] / C0, result.count, result.overflow

    grey = replace(gaussians, sh=sh)
    for camera in cameras:
        weight, capacity = until_it_fits(
            lambda entries, camera=camera: gradient(grey, camera, capacity=entries), capacity
        )
        total += np.asarray(weight, np.float64)
    return total


def _largest_that_fits(room: int, gaussians: Gaussians, order: np.ndarray) -> Packed | None:
    """Return the first Gaussians in `order`, nearly as many as fit; None: no attempt succeeded."""
    full = pack(gaussians)
    if len(full.data) <= room:
        return full
    count = gaussians.capacity
    keep = int(count * room / len(full.data) * MARGIN)
    for _ in range(ATTEMPTS):
        if keep < LEAST_SHARE * count:
            return None
        packed = pack(chosen(gaussians, np.sort(order[:keep])))
        if len(packed.data) <= room:
            return packed
        keep = int(keep * room / len(packed.data) * MARGIN)
    return None


def page_error(
    gaussians: Gaussians, pictures: Sequence[RunPicture], render: RenderView
) -> PageError:
    """Compare pictures of the page's Gaussians with one or more true pictures."""
    psnrs, stops = [], []
    for true in pictures:
        linear = radiance_of(gaussians, true.camera, render)
        display = develop(linear, true.transform)
        square = np.mean((display - true.display) ** 2, dtype=np.float64)
        psnrs.append(float(-10 * np.log10(max(square, LEAST_ERROR))))
        stops.append(_stops(linear, true))
    # A view may be entirely black.
    differences = np.concatenate([np.zeros(1), *stops])
    worst = int(np.argmin(psnrs))
    return PageError(
        views=len(pictures),
        psnr_median=float(np.median(psnrs)),
        psnr_worst=psnrs[worst],
        worst_view=pictures[worst].name,
        stops_median=float(np.median(differences)),
        stops_p99=float(np.percentile(differences, 99)),
        stops_max=float(differences.max()),
    )


def _stops(linear: Float32[np.ndarray, "h w 3"], true: RunPicture) -> Float[np.ndarray, " p"]:
    lit = true.display.max(-1) >= DARKEST_LEVEL / 255
    page, run = (np.maximum(luminance(p[lit]), 1e-12) for p in (linear, true.linear))
    return np.abs(np.log2(page / run))


def radiance_of(g: Gaussians, camera: Camera, render: RenderView) -> Float32[np.ndarray, "h w 3"]:
    """Return the linear radiance of all Gaussians in the picture of a camera."""
    return np.asarray(render(g, g.all_alive, camera).linear)
