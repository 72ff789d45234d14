"""The result: exposures, gammas and response of a scene, with what is known of their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import CameraFormation, Level, VignettingKind
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.models import ModelName
from p2gs_jax.photometry.response import Response
from p2gs_jax.types import GAMMA_SRGB

# Views with fewer usable observations have uncertain exposures.
MIN_OBSERVATIONS = 15
# Gammas with a larger standard error are only roughly known.
WEAK_GAMMA = 0.1


@dataclass(frozen=True)
class PhotometricSolution:
    """Exposures, gammas and response, with what is known about their errors.

    Attributes:
        model: what varies.
        response: base curve and spline.
        log_exposures: natural logarithm; mean 0 over each component unless exposures were known.
        exposure_errors: standard errors of `log_exposures` (robust, gauge fixed); inf where
            unobserved or not to be told.
        gammas: per view.
        gamma_errors: standard errors; 0 where gamma is not modelled, inf as above.
        observations_per_view: usable observations.
        component: views with equal numbers share a scale; others cannot be compared.
        point_log_radiance: natural logarithm per channel; NaN where unobserved.
        residual_ev: robust standard deviation of one observation, in stops.
        view_residual_ev: the same per view.
        view_balance_ev: median residual of red, green, blue in each view less their mean, stops:
            what a scalar exposure leaves of a white balance; NaN where unobserved.
        outliers: share of observations that the robust loss ignores.
        rounds: iterations.
        moved: largest change of a parameter in the last of them, log units.
        converged: that was no more than the tolerance.
        unknown_errors: observed views whose standard errors cannot be told.
        warnings: what the user should know.
        white_balance_level: per what the white balance varies; None: it does not.
        white_balance: log factors on red, green, blue beside the exposure: mean 0 in every view,
            and over the views of a component; zeros where it does not vary.
        white_balance_errors: standard errors, as `exposure_errors`.
        vignetting: whether cameras darken towards their corners, and each channel in its own way.
        cameras: what each physical camera does, by its row in `Observations.cameras`; empty where
            none does anything of its own.
        corner_errors: standard errors of log V in the corner, per camera and row of `vignetting`.
    """

    model: ModelName
    response: Response
    log_exposures: Float[np.ndarray, " v"]
    exposure_errors: Float[np.ndarray, " v"]
    gammas: Float[np.ndarray, " v"]
    gamma_errors: Float[np.ndarray, " v"]
    observations_per_view: Int[np.ndarray, " v"]
    component: Int[np.ndarray, " v"]
    point_log_radiance: Float[np.ndarray, "p 3"]
    residual_ev: float
    view_residual_ev: Float[np.ndarray, " v"]
    view_balance_ev: Float[np.ndarray, "v 3"]
    outliers: float
    rounds: int
    moved: float
    converged: bool
    unknown_errors: int
    warnings: tuple[str, ...]
    white_balance_level: Level | None
    white_balance: Float[np.ndarray, "v 3"]
    white_balance_errors: Float[np.ndarray, "v 3"]
    vignetting: VignettingKind | None
    cameras: tuple[CameraFormation, ...]
    corner_errors: Float[np.ndarray, "c k"]

    @property
    def state(self) -> dict[str, Any]:
        """How the solution ended, for `metrics.json` and `calibration.json`."""
        names = ("rounds", "converged", "unknown_errors")
        return {"last_change": self.moved, **{k: getattr(self, k) for k in names}}

    @property
    def exposures_ev(self) -> Float[np.ndarray, " v"]:
        """Exposures in stops."""
        return self.log_exposures / LN2

    def exposures_ev_at(self, level: float, pivot: float) -> Float[np.ndarray, " v"]:
        """Return exposures in stops as they act on one level of tone.

        Where gammas differ between views, "the exposure" depends on where it is read: at the
        pivot by definition, at another level it includes what gamma does there.

        Args:
            level: linear value of the base curve, 1 = white.
            pivot: linear value that gammas leave alone.
        """
        a = GAMMA_SRGB / self.gammas
        return (self.log_exposures + np.log(level / pivot) * (1 - 1 / a)) / LN2
