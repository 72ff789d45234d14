"""Exposures and response of a stack: one fixed viewpoint, several exposures, no poses needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.photometry.adjustment.problem import KnownExposures, Problem
from p2gs_jax.photometry.calibrate import CalibrationOptions, calibrate_observations
from p2gs_jax.photometry.solution import Agreement, PhotometricSolution, compare
from p2gs_jax.photometry.sources.stack import SATURATED, StackColors, read_stack, stack_colors
from p2gs_jax.photometry.unmodelled import LOCAL_EV, Unexplained, residuals, unexplained
from p2gs_jax.scene.exposures import read_known_exposures, stated_ev
from p2gs_jax.types import View

PIVOT = 0.18


@dataclass(frozen=True)
class StackResult:
    """What a stack says.

    Attributes:
        views: the photographs; poses mean nothing.
        solution: exposures and common response.
        known: where known exposures came from, or None.
        stated_ev: stated exposures in stops, moved to the recovered ones; NaN where unknown.
        agreement: of the two, on frames that carry signal.
        signal: frames in which enough points are neither black nor saturated.
        shifts: pixels by which each frame was moved to fit the first.
        black: values up to here were taken as black.
        curve_ev: residual that depends on brightness, frame by frame, stops.
        local_ev: smooth residual over the image at equal brightness, stops.
        problem: the observations.
        xy: their positions.
        messages: what the user should know.
    """

    views: tuple[View, ...]
    solution: PhotometricSolution
    known: str | None
    stated_ev: Float[np.ndarray, " v"]
    agreement: Agreement
    signal: Bool[np.ndarray, " v"]
    shifts: Float[np.ndarray, "v 2"]
    black: float
    curve_ev: float
    local_ev: float
    problem: Problem
    xy: Float[np.ndarray, "p 2"]
    messages: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """File names."""
        return [v.name for v in self.views]

    @property
    def one_response(self) -> bool:
        """Whether one response explains the stack."""
        return self.local_ev <= LOCAL_EV

    @property
    def pivot(self) -> float:
        """Linear value that gammas leave alone."""
        return PIVOT

    @property
    def gauge(self) -> str:
        """What fixes the scale where no exposures are known, in words."""
        return "mean log exposure is 0; exposures and response can be stretched together"

    @property
    def details(self) -> dict[str, Any]:
        """The content of `calibration.json`."""
        return {
            "messages": self.messages,
            "signal": self.signal,
            "shifts": self.shifts,
            "black": self.black,
            "one_response": self.one_response,
            "local_ev": self.local_ev,
            "curve_ev": self.curve_ev,
            "residual_ev": self.solution.residual_ev,
        }


def calibrate_stack(
    folder: str | Path,
    *,
    known: str | None = None,
    known_deviation_ev: float = 0.0,
    compare_with: str | None = None,
    seed: int = 0,
) -> StackResult:
    """Solve exposures and the common response of a stack.

    Without known exposures, their logarithms are found up to a factor: exposures and response
    can be stretched together (the power gauge), which the standard curves' mid tones settle.

    Args:
        folder: photographs of one viewpoint.
        known: exposures to keep: `exif` or a CSV file; the response is then solved with them.
        known_deviation_ev: their standard deviation, stops; 0 keeps them as they are.
        compare_with: stated exposures to report beside the recovered ones; default EXIF.
        seed: of the sampled positions.

    Raises:
        UserError: see `read_stack` and `read_known_exposures`.
    """
    stack = read_stack(Path(folder))
    views = list(stack.views)
    given = None
    if known is not None:
        given = KnownExposures(read_known_exposures(known, views), known_deviation_ev)
    stated = stated_ev(compare_with, views)
    found = stack_colors(stack, seed)
    options = CalibrationOptions(found.black, SATURATED, PIVOT, given, seed, "one_response")
    selection = calibrate_observations(found.observations, options)
    solution, problem = selection.solution, options.problem(found.observations)
    left = unexplained(
        problem, residuals(problem, solution), found.xy, stack.valid.shape, found.signal
    )
    errors_ev = np.where(found.signal, solution.exposure_errors_ev, np.inf)
    agreement = compare(solution.exposures_ev, errors_ev, stated)
    messages = [*selection.reasons, *solution.warnings, *_stack_messages(stack.views, found, left)]
    if agreement.views >= 2:
        messages.append(agreement.sentence("The stated exposures"))
    return StackResult(
        views=stack.views,
        solution=solution,
        known=known,
        stated_ev=stated + agreement.offset_ev,
        agreement=agreement,
        signal=found.signal,
        shifts=found.shifts,
        black=found.black,
        curve_ev=left.curve_ev,
        local_ev=left.local_ev,
        problem=problem,
        xy=found.xy,
        messages=tuple(messages),
    )


def _stack_messages(views: tuple[View, ...], found: StackColors, left: Unexplained) -> list[str]:
    """Say which frames are dark, that frames were moved, and that one response is not enough."""
    out = []
    dark = [view.name for view, signal in zip(views, found.signal, strict=True) if not signal]
    if dark:
        out.append(
            f"{len(dark)} frame(s) carry little signal (black or saturated nearly everywhere): "
            f"{', '.join(dark[:6])}."
        )
    moved = np.abs(found.shifts).max()
    if moved > 0:
        out.append(f"Frames were moved by up to {moved:.0f} pixel(s).")
    if left.local_ev > LOCAL_EV:
        out.append(
            f"One response does not explain this stack: between frames, regions of equal "
            f"brightness change by {left.local_ev:.2f} EV (RMS; {LOCAL_EV:g} at most for one "
            "camera pipeline). The frames were tone-mapped by region, or the light changed; do not "
            "trust the exposures."
        )
    return out
