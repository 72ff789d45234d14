"""The files of a calibration, whatever its source: two of numbers and a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.atomic import write_json
from p2gs_jax.photometry.solution import Agreement, PhotometricSolution
from p2gs_jax.run.calibration_plot import write_calibration_plot
from p2gs_jax.run.photometry_file import write_solution
from p2gs_jax.types import View


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
        known=result.known,
        gauge=result.gauge,
    )
    write_json(out / "calibration.json", result.details)
    write_calibration_plot(
        out / "calibration.png",
        result.solution,
        cameras=[v.camera for v in result.views],
        stated_ev=result.stated_ev,
        pivot=result.pivot,
    )
