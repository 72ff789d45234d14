"""The result: exposures, gammas and response of a scene, what is known of their errors, and
whether they agree with what the cameras say they did.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import CameraFormation, Level, VignettingKind
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.models import ModelName
from p2gs_jax.photometry.response import Response

MIN_OBSERVATIONS = 15  # views with fewer usable observations have uncertain exposures
WEAK_GAMMA = 0.1  # gammas with a larger standard error are only roughly known
# A view disagrees when its gap exceeds this, and three standard errors.
NOTICEABLE_EV = 0.2
STANDARD_ERRORS = 3.0

PerView = Float[np.ndarray, " v"]


@dataclass(frozen=True)
class PhotometricSolution:
    """Exposures, gammas and response, with what is known about their errors."""

    model: ModelName  # what varies
    response: Response  # base curve and spline
    # Natural logarithm; mean 0 over each component unless exposures were known.
    log_exposures: PerView
    # Standard errors of `log_exposures` (robust, gauge fixed); inf where unobserved or not to be
    # told.
    exposure_errors: PerView
    gammas: PerView  # per view
    gamma_errors: PerView  # standard errors; 0 where gamma is not modelled, inf as above
    observations_per_view: Int[np.ndarray, " v"]  # usable observations
    # Views with equal numbers share a scale; others cannot be compared.
    component: Int[np.ndarray, " v"]
    # Natural logarithm per channel; NaN where unobserved.
    point_log_radiance: Float[np.ndarray, "p 3"]
    residual_ev: float  # robust standard deviation of one observation, in stops
    view_residual_ev: PerView  # the same per view
    # Median residual of red, green, blue in each view less their mean, stops: what a scalar
    # exposure leaves of a white balance; NaN where unobserved.
    view_balance_ev: Float[np.ndarray, "v 3"]
    outliers: float  # share of observations that the robust loss ignores
    rounds: int  # iterations
    moved: float  # largest change of a parameter in the last of them, log units
    converged: bool  # that was no more than the tolerance
    unknown_errors: int  # observed views whose standard errors cannot be told
    warnings: tuple[str, ...]  # what the user should know
    white_balance_level: Level | None  # per what the white balance varies; None: it does not
    # Log factors on red, green, blue beside the exposure: mean 0 in every view, and over the views
    # of a component; zeros where it does not vary.
    white_balance: Float[np.ndarray, "v 3"]
    white_balance_errors: Float[np.ndarray, "v 3"]  # standard errors, as `exposure_errors`
    # Whether cameras darken towards their corners, and each channel in its own way.
    vignetting: VignettingKind | None
    # What each physical camera does, by its row in `Observations.cameras`; empty where none does
    # anything of its own.
    cameras: tuple[CameraFormation, ...]
    # Standard errors of log V in the corner, per camera and row of `vignetting`.
    corner_errors: Float[np.ndarray, "c k"]

    @property
    def state(self) -> dict[str, Any]:
        """How the solution ended, for `metrics.json` and `calibration.json`."""
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
    """Recovered exposures against stated ones (EXIF), scale aligned."""

    views: int  # how many have both
    correlation: float  # of the two, in stops; NaN where one of them does not vary
    # Recovered over stated, least squares; other than 1 is the power gauge or tone mapping.
    slope: float
    rms_ev: float  # RMS gap in stops
    offset_ev: float  # what to add to stated exposures to lay them over the recovered ones
    gap_ev: PerView  # recovered minus stated, median removed; NaN where either is missing
    disagrees: Bool[np.ndarray, " v"]  # views whose gap is noticeable and significant

    def sentence(self, source: str = "EXIF") -> str:
        """Say it in words."""
        if self.views < 2:
            return f"{source} gives the exposure of {self.views} view(s): nothing to compare."
        head = (
            f"{source} of {self.views} views: correlation {self.correlation:.3f}, slope "
            f"{self.slope:.2f}, RMS {self.rms_ev:.2f} EV."
        )
        count = int(self.disagrees.sum())
        if not count:
            return head + f" {source} and the pixels agree within {NOTICEABLE_EV:g} EV."
        worst = float(np.nanmax(np.abs(self.gap_ev)))
        return head + (
            f" {source} disagrees with the pixels in {count} of {self.views} views, by up to "
            f"{worst:.2f} EV."
        )


def compare(exposures_ev: PerView, errors_ev: PerView, stated_ev: PerView) -> Agreement:
    """Compare recovered exposures, stops, with stated ones: NaN where unknown; errors then inf."""
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
