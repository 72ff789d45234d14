"""Held-out views under the exposure that a metering rule gives their renders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluation.passes import ArrayStore, StoredArray, map_in_order
from p2gs_jax.photometry.metering import Metering, Readings, fit_metering, white_level


class _Kept(NamedTuple):
    """A held-out view until the rule is known, which needs all training views."""

    row: int
    readings: Readings
    images: tuple[StoredArray, ...]
    alpha: StoredArray | None


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
        self,
        index: int,
        readings: Readings,
        linear: np.ndarray | StoredArray,
        photograph: Float32[np.ndarray, "h w 3"],
        mask: Float32[np.ndarray, "h w"],
        alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Keep a held-out view by its row; its opacity where it is put over a background."""
        images = tuple(map(self._arrays.put, (linear, photograph, mask)))
        opacity = None if alpha is None else self._arrays.put(alpha)
        self._kept.append(_Kept(index, readings, images, opacity))

    def fit(
        self, exposures: Float[np.ndarray, " v"], gamma: float, tone: PhotometryConfig
    ) -> Metering:
        """Return the rule that explains the exposures of the training views, in the order added.

        `gamma` is that of new views.
        """
        logs = np.log(np.asarray(exposures, np.float64))
        return fit_metering(self._names, self._readings, logs, white_level(gamma, tone))

    def scores(
        self, metering: Metering, score: Callable[..., dict[str, Any]]
    ) -> dict[int, dict[str, Any]]:
        """Return scores of every held-out view by its row; none where the rule is a constant.

        `score` is called with (row, linear, exposure, photograph, mask, alpha).
        """
        if not metering.rule.meters:
            return {}

        def judged(view: _Kept) -> dict[str, Any]:
            exposure = metering.exposure(view.readings)
            linear, photograph, mask = (image.read() for image in view.images)
            alpha = None if view.alpha is None else view.alpha.read()
            row = score(view.row, linear, exposure, photograph, mask, alpha)
            return {**row, "exposure": exposure}

        rows = [view.row for view in self._kept]
        return dict(zip(rows, map_in_order(judged, self._kept), strict=True))
