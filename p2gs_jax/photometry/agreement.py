"""Do the pixels agree with what the cameras say they did?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.models import MODELS
from p2gs_jax.photometry.solution import PhotometricSolution

# A view disagrees when its gap exceeds this, and three standard errors.
NOTICEABLE_EV = 0.2
STANDARD_ERRORS = 3.0
# Linear values at which exposures may be read instead of at the pivot.
LEVELS = (0.05, 0.1, 0.18, 0.3, 0.5, 0.8)
# One of them is worth a word where its RMS gap is below this share of the pivot's.
NOTICEABLE_RMS_SHARE = 0.8


class Agreement(NamedTuple):
    """Recovered exposures against stated ones (EXIF), scale aligned.

    Attributes:
        views: how many have both.
        correlation: of the two, in stops; NaN where one of them does not vary.
        slope: recovered over stated, least squares; other than 1 is the power gauge or tone
            mapping.
        rms_ev: RMS gap in stops.
        offset_ev: what to add to stated exposures to lay them over the recovered ones.
        gap_ev: recovered minus stated, median removed; NaN where either is missing.
        disagrees: views whose gap is noticeable and significant.
    """

    views: int
    correlation: float
    slope: float
    rms_ev: float
    offset_ev: float
    gap_ev: Float[np.ndarray, " v"]
    disagrees: Bool[np.ndarray, " v"]

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


def compare(
    exposures_ev: Float[np.ndarray, " v"],
    errors_ev: Float[np.ndarray, " v"],
    stated_ev: Float[np.ndarray, " v"],
) -> Agreement:
    """Compare recovered with stated exposures.

    Args:
        exposures_ev: recovered, stops.
        errors_ev: their standard errors; inf where unknown.
        stated_ev: stated, stops up to a constant; NaN where unknown.
    """
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


def note_on_levels(
    solution: PhotometricSolution,
    stated_ev: Float[np.ndarray, " v"],
    agreement: Agreement,
    pivot: float,
) -> list[str]:
    """Say at which level stated exposures agree best, where gammas make them depend on it.

    Args:
        solution: exposures and gammas.
        stated_ev: stops up to a constant; NaN where unknown.
        agreement: of the two at the pivot.
        pivot: linear value that gammas leave alone.
    """
    if MODELS[solution.model].gamma is None or agreement.views < 3:
        return []
    errors_ev = solution.exposure_errors / LN2
    options = {x: compare(solution.exposures_ev_at(x, pivot), errors_ev, stated_ev) for x in LEVELS}
    level = min(options, key=lambda x: options[x].rms_ev)
    best = options[level]
    if not best.rms_ev < NOTICEABLE_RMS_SHARE * agreement.rms_ev:
        return []
    return [
        f"Read at a linear value of {level:g} instead of {pivot:g}, correlation is "
        f"{best.correlation:.3f}, slope {best.slope:.2f}, RMS {best.rms_ev:.2f} EV: the cameras "
        "did not only change exposure, they also moved other tones against it."
    ]
