"""Views that cannot be judged, and photographs whose exposure nothing tells."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32

from p2gs_jax.config import LossConfig

# Of the pixels that count, so many at least must lie between black and saturation.
FEWEST = 1e-3
_NAMED = 8


@dataclass
class Untold:
    """What evaluation finds of views.

    Attributes:
        hidden: names of views of which masks leave nothing: they have no scores.
        exposures: names of views that are black or saturated everywhere: any exposure that is dark
            or bright enough explains them.
    """

    hidden: list[str] = field(default_factory=list)
    exposures: list[str] = field(default_factory=list)

    def add(
        self,
        name: str,
        photograph: Float32[np.ndarray, "h w 3"],
        mask: Float32[np.ndarray, "h w"],
        loss: LossConfig,
    ) -> bool:
        """Look at a view; return whether it can be judged.

        Args:
            name: of the view.
            photograph: display values.
            mask: 1 where pixels count.
            loss: what is black and what saturated.
        """
        counted = photograph[mask > 0]
        if not len(counted):
            self.hidden.append(name)
            return False
        tells = ((counted > loss.black) & (counted < loss.saturation)).any(1)
        if tells.mean() < FEWEST:
            self.exposures.append(name)
        return True

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of `metrics.json`; empty where all is told."""
        found = {"hidden": self.hidden, "exposures_unknown": self.exposures}
        return {key: names for key, names in found.items() if names}


def untold_notes(metrics: dict[str, Any]) -> list[str]:
    """Return what the user should know of these views, in sentences.

    Args:
        metrics: of an evaluation.
    """
    out = []
    if hidden := metrics.get("hidden"):
        out.append(
            f"{len(hidden)} view(s) are hidden by their masks altogether and have no scores "
            f"({_listed(hidden)})."
        )
    if unknown := metrics.get("exposures_unknown"):
        out.append(
            f"{len(unknown)} photograph(s) are black or saturated everywhere: their exposures are "
            f"unknown, whatever photometry.json holds ({_listed(unknown)})."
        )
    return out


def _listed(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
