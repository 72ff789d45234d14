"""The photometric solution of a scene with its standard errors, and its agreement with EXIF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import CameraFormation, Level, VignettingKind
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.text import count_of
from p2gs_jax.photometry.models import ModelName
from p2gs_jax.photometry.response import Response

MIN_OBSERVATIONS = 15  # exposures of views with fewer usable observations are uncertain
WEAK_GAMMA = 0.1  # gammas with a larger standard error are only roughly known
# A view disagrees if its gap exceeds this and 3 standard errors.
NOTICEABLE_EV = 0.2
STANDARD_ERRORS = 3.0

PerView = Float[np.ndarray, " v"]


@dataclass(frozen=True)
class PhotometricSolution:
    """Exposures, gammas and response, with their standard errors."""

    model: ModelName  # exposures and gammas that vary
    response: Response  # base curve and spline
    # Natural logarithm; mean 0 over the observed views of a component without known exposures. A
    # view without observations has that of its camera, or 0 if it varies per view.
    log_exposures: PerView
    # Standard errors of `log_exposures` (robust, gauge fixed); inf where unobserved or unknown.
    exposure_errors: PerView
    gammas: PerView
    gamma_errors: PerView  # standard errors; 0 where gamma is not modelled, inf as above
    observations_per_view: Int[np.ndarray, " v"]  # number of usable observations
    # Label of each view: views with equal labels share a scale, others cannot be compared.
    component: Int[np.ndarray, " v"]
    # Natural logarithm per channel; NaN where unobserved.
    point_log_radiance: Float[np.ndarray, "p 3"]
    residual_ev: float  # robust standard deviation of one observation, stops
    view_residual_ev: PerView  # the same per view
    # Median residual of red, green, blue in each view minus their mean, stops: white balance that
    # the model does not explain. NaN: a channel has fewer than MIN_OBSERVATIONS usable values.
    view_balance_ev: Float[np.ndarray, "v 3"]
    outliers: float  # share of usable values that the robust loss largely ignores
    rounds: int  # number of iterations
    moved: float  # largest change of a parameter in the last iteration, log units
    converged: bool  # `moved` is below the tolerance
    unknown_errors: int  # number of views with data or a known exposure, but no standard errors
    warnings: tuple[str, ...]
    white_balance_level: Level | None  # level of the white balance; None: it does not vary
    # Log factors on red, green, blue beside the exposure: their mean is 0 in every view and over
    # the observed views of a component. They are 0 if white balance does not vary.
    white_balance: Float[np.ndarray, "v 3"]
    white_balance_errors: Float[np.ndarray, "v 3"]  # standard errors, as `exposure_errors`
    vignetting: VignettingKind | None  # per camera, or per camera and channel
    # Vignetting and response of each physical camera, by row in `Observations.cameras`; empty if
    # none has any.
    cameras: tuple[CameraFormation, ...]
    # Standard errors of log V in the corner, per camera and row of `vignetting`.
    corner_errors: Float[np.ndarray, "c k"]

    @property
    def state(self) -> dict[str, Any]:
        """Convergence of the solution, for `metrics.json` and `calibration.json`."""
        names = ("rounds", "converged", "unknown_errors")
        return {"last_change": self.moved, **{k: getattr(self, k) for k in names}}

    @property
    def exposures_ev(self) -> PerView:
        """Exposures in stops."""
        return self.log_exposures / LN2

    @property
    def exposure_errors_ev(self) -> PerView:
        """Standard errors of the exposures in stops; inf where unknown."""
        return self.exposure_errors / LN2


class Agreement(NamedTuple):
    """Agreement of recovered with stated exposures (EXIF), after their scales are aligned."""

    views: int  # number of views with both; below 2, only `offset_ev` is a number
    correlation: float  # correlation of both, in stops; NaN if either does not vary
    # Least-squares slope of recovered over stated stops; the power gauge or tone mapping makes it
    # differ from 1. NaN if either does not vary.
    slope: float
    rms_ev: float  # RMS difference about its mean, stops
    offset_ev: float  # median of recovered minus stated, stops
    gap_ev: PerView  # recovered minus stated minus offset, stops; NaN where either is missing
    disagrees: Bool[np.ndarray, " v"]  # views whose gap is noticeable and significant

    def sentence(self, source: str = "EXIF") -> str:
        """Return a sentence for the user."""
        if self.views < 2:
            known = count_of(self.views, "view")
            return f"{source} gives the exposure of {known}: nothing to compare."
        fit = f"correlation {self.correlation:.3f}, slope {self.slope:.2f}, "
        fit = "" if np.isnan(self.slope) else fit
        head = f"{source} of {self.views} views: {fit}RMS {self.rms_ev:.3f} EV."
        count = int(self.disagrees.sum())
        if not count:
            return head + f" {source} and the pixels agree within {NOTICEABLE_EV:g} EV."
        worst = float(np.nanmax(np.abs(self.gap_ev)))
        return head + (
            f" {source} disagrees with the pixels in {count} of {self.views} views, by up to "
            f"{worst:.2f} EV."
        )


def compare(exposures_ev: PerView, errors_ev: PerView, stated_ev: PerView) -> Agreement:
    """Compare exposures in stops; unknown ones are NaN (stated) or have errors of inf."""
    both = np.isfinite(stated_ev) & np.isfinite(errors_ev)
    gap = np.full(len(exposures_ev), np.nan)
    count = int(both.sum())
    a, b = exposures_ev[both], stated_ev[both]
    difference = a - b
    offset = float(np.median(difference)) if count else 0.0
    if count < 2:
        nan, nowhere = float("nan"), np.zeros(len(gap), bool)
        return Agreement(count, nan, nan, nan, offset, gap, nowhere)
    gap[both] = difference - offset
    a, b = a - a.mean(), b - b.mean()
    varies = a @ a > 1e-9 and b @ b > 1e-9
    with np.errstate(invalid="ignore"):
        disagrees = np.abs(gap) > np.maximum(NOTICEABLE_EV, STANDARD_ERRORS * errors_ev)
    return Agreement(
        count,
        float(a @ b / np.sqrt((a @ a) * (b @ b))) if varies else float("nan"),
        float(a @ b / (b @ b)) if varies else float("nan"),
        float(np.sqrt(np.mean((difference - difference.mean()) ** 2))),
        offset,
        gap,
        disagrees & both,
    )
