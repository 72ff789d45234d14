"""What a calibration of posed views found, laid beside what the cameras say they did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.solution import Agreement, PhotometricSolution, compare, note_on_levels
from p2gs_jax.run.photometry_files import write_solution
from p2gs_jax.run.plots import write_calibration_plot
from p2gs_jax.scene.exposures import stated_ev
from p2gs_jax.types import Scene, View


@dataclass(frozen=True)
class Calibration:
    """What `p2gs-jax calibrate` finds.

    Attributes:
        scene: all its views are used.
        selection: model, exposures, gammas, errors, reasons.
        stated_ev: exposures from EXIF or a file, stops, laid over the recovered ones; NaN where
            unknown.
        stated_by: what stated them, for reports.
        agreement: of the two.
        level_note: where in the tonal range they agree better, if anywhere.
        observations: used.
        seconds: of reading and sampling, and of the adjustment.
        pivot: linear value that gammas leave alone.
        known: where known exposures came from, or None.
    """

    scene: Scene
    selection: Selection
    stated_ev: np.ndarray
    stated_by: str
    agreement: Agreement
    level_note: list[str]
    observations: int
    seconds: dict[str, float]
    pivot: float
    known: str | None

    @property
    def views(self) -> tuple[View, ...]:
        """The photographs, in the order of the solution."""
        return self.scene.views

    @property
    def solution(self) -> PhotometricSolution:
        """Exposures, gammas, response and their errors."""
        return self.selection.solution

    @property
    def gauge(self) -> str:
        """What fixes the scale where no exposures are known, in words."""
        return "mean log exposure is 0 over each connected group of views"

    @property
    def messages(self) -> list[str]:
        """What the user should know, in plain words."""
        out = [*self.scene.notes, *self.selection.reasons, *self.solution.warnings]
        if self.agreement.views:
            out.append(self.agreement.sentence(self.stated_by))
            out += self.level_note
        return out

    @property
    def details(self) -> dict[str, Any]:
        """The content of `calibration.json`."""
        s = self.solution
        return {
            "messages": self.messages,
            "observations": self.observations,
            "seconds": self.seconds,
            "solution": s.state,
            "residual_ev": s.residual_ev,
            "view_residual_ev": s.view_residual_ev,
            "view_balance_ev": s.view_balance_ev,
            "outliers": s.outliers,
            "component": s.component,
            "observations_per_view": s.observations_per_view,
            "agreement": self.agreement._asdict(),
            "candidates": [
                {
                    "model": c.form.model,
                    "white_balance": c.form.white_balance,
                    "vignetting": c.form.vignetting,
                    "curve": c.response.name,
                    "parameters": c.parameters,
                    "density": c.density,
                    "behind": c.deficit,
                    "behind_error": c.deficit_error,
                    "codes": c.difference,
                }
                for c in self.selection.candidates
            ],
        }


def with_stated(
    scene: Scene,
    selection: Selection,
    photometry: PhotometryConfig,
    *,
    observations: int,
    seconds: dict[str, float],
    compare_with: str | None,
) -> Calibration:
    """Compare a solution with stated exposures.

    Args:
        scene: its views are those of the solution.
        selection: the solution.
        photometry: options that it was solved with.
        observations: how many it used.
        seconds: see `Calibration`.
        compare_with: stated exposures: `exif` or a CSV file; default EXIF where there is any.

    Raises:
        UserError: the stated exposures cannot be read.
    """
    stated = stated_ev(compare_with, list(scene.views))
    s, pivot = selection.solution, photometry.pivot
    agreement = compare(s.exposures_ev, s.exposure_errors_ev, stated)
    return Calibration(
        scene=scene,
        selection=selection,
        stated_ev=stated + agreement.offset_ev,
        stated_by="EXIF" if compare_with in (None, "exif") else Path(str(compare_with)).name,
        agreement=agreement,
        level_note=note_on_levels(s, stated, agreement, pivot),
        observations=observations,
        seconds=seconds,
        pivot=pivot,
        known=photometry.known,
    )


class CalibrationResult(Protocol):
    """What a calibration says: all that its files and its table need."""

    @property
    def views(self) -> Sequence[View]:
        """The photographs, in the order of the solution."""
        ...

    @property
    def solution(self) -> PhotometricSolution:
        """Exposures, gammas, response."""
        ...

    @property
    def pivot(self) -> float:
        """Linear value that gammas leave alone."""
        ...

    @property
    def known(self) -> str | None:
        """Where known exposures came from, or None."""
        ...

    @property
    def gauge(self) -> str:
        """What fixes the scale where none are known, in words."""
        ...

    @property
    def stated_ev(self) -> Float[np.ndarray, " v"]:
        """Stated exposures in stops, laid over the recovered ones; NaN where unknown."""
        ...

    @property
    def agreement(self) -> Agreement:
        """Of recovered and stated exposures."""
        ...

    @property
    def messages(self) -> Sequence[str]:
        """What the user should know."""
        ...

    @property
    def details(self) -> dict[str, Any]:
        """The content of `calibration.json`."""
        ...


def write_calibration(result: CalibrationResult, out: Path) -> None:
    """Write `photometry.json`, `calibration.json` and `calibration.png`.

    Args:
        result: what was found.
        out: folder; created.
    """
    write_solution(
        out / "photometry.json",
        result.solution,
        views=result.views,
        pivot=result.pivot,
        gauge=result.gauge if result.known is None else f"known exposures ({result.known})",
    )
    write_json(out / "calibration.json", result.details)
    write_calibration_plot(
        out / "calibration.png",
        result.solution,
        cameras=[v.camera for v in result.views],
        stated_ev=result.stated_ev,
        pivot=result.pivot,
    )
