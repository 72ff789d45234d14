"""`metrics.json` of older versions, under the names of today."""

from __future__ import annotations

from typing import Any

RENAMED = {"exposure_and_gamma_fitted": "photometry_fitted"}


def as_today(metrics: dict[str, Any]) -> dict[str, Any]:
    """Return what `metrics.json` holds, with the protocols of held-out views as they are called."""
    test = metrics.get("test")
    if not isinstance(test, dict):
        return metrics
    return {**metrics, "test": {RENAMED.get(name, name): part for name, part in test.items()}}
