"""Held-out views under the exposure that a metering rule gives their renders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluation.passes import ArrayStore, StoredArray, map_in_order
from p2gs_jax.photometry.formation import exposed_at
from p2gs_jax.photometry.metering import BELOW_WHITE, Metering, Readings, fit_metering


class _Kept(NamedTuple):
    """A held-out view until the rule is known, which needs all training views."""

    row: int
    readings: Readings
    images: tuple[StoredArray, ...]


class MeteredViews:
    """Collects what the meters read, fits the rule, and scores held-out views under it.

    Held-out views are kept in `arrays`.
    """

    def __init__(self, arrays: ArrayStore):
        self._arrays = arrays
        self._names: list[str] = []
        self._readings: list[Readings] = []
        self._kept: list[_Kept] = []

    def add_training(self, name: str, readings: Readings) -> None:
        """Take what the meters read in a training view."""
        self._names.append(name)
        self._readings.append(readings)

    def add_held_out(
        self, index: int, readings: Readings, *images: np.ndarray | StoredArray
    ) -> None:
        """Keep a held-out view by its row: its radiance, photograph and mask.

        Over a background also its opacity.
        """
        self._kept.append(_Kept(index, readings, tuple(map(self._arrays.put, images))))

    def fit(
        self, exposures: Float[np.ndarray, " v"], gamma: float, tone: PhotometryConfig
    ) -> Metering:
        """Return the rule that explains the exposures of the training views, in the order added.

        `gamma` is that of new views.
        """
        logs = np.log(np.asarray(exposures, np.float64))
        white = exposed_at(BELOW_WHITE, gamma, tone)
        return fit_metering(self._names, self._readings, logs, white)

    def scores(
        self, metering: Metering, score: Callable[..., dict[str, Any]]
    ) -> dict[int, dict[str, Any]]:
        """Return scores of every held-out view by its row; none where the rule is a constant.

        `score` is called with (row, exposure, linear, photograph, mask), and the opacity if any.
        """
        if not metering.rule.meters:
            return {}

        def judged(view: _Kept) -> dict[str, Any]:
            exposure = metering.exposure(view.readings)
            row = score(view.row, exposure, *(image.read() for image in view.images))
            return {**row, "exposure": exposure}

        rows = [view.row for view in self._kept]
        return dict(zip(rows, map_in_order(judged, self._kept), strict=True))
