"""Held-out views under the exposure that a metering rule gives their renders."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluation.passes import ArrayStore, StoredArray, map_in_order
from p2gs_jax.photometry.metering import Metering, Readings, fit_metering, white_level


class _Kept(NamedTuple):
    """A held-out view until the rule is known, which needs all training views."""

    name: str
    readings: Readings
    linear: StoredArray
    photograph: StoredArray
    mask: StoredArray
    alpha: StoredArray | None


class MeteredViews:
    """Collects what the meters read, fits the rule, and scores held-out views under it."""

    def __init__(self, arrays: ArrayStore):
        """Begin empty.

        Args:
            arrays: keeps held-out views.
        """
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
        name: str,
        readings: Readings,
        linear: np.ndarray | StoredArray,
        photograph: Float32[np.ndarray, "h w 3"],
        mask: Float32[np.ndarray, "h w"],
        alpha: Float32[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Keep a held-out view; its opacity where it is put over a background."""
        put = self._arrays.put
        opacity = None if alpha is None else put(alpha)
        self._kept.append(_Kept(name, readings, put(linear), put(photograph), put(mask), opacity))

    def fit(
        self, exposures: Float[np.ndarray, " v"], gamma: float, tone: PhotometryConfig
    ) -> Metering:
        """Return the rule that explains the training views.

        Args:
            exposures: of the training views, in the order in which they were added.
            gamma: of new views.
            tone: tone curve.
        """
        logs = np.log(np.asarray(exposures, np.float64))
        return fit_metering(self._names, self._readings, logs, white_level(gamma, tone))

    def scores(
        self, metering: Metering, score: Callable[..., dict[str, float]]
    ) -> dict[str, dict[str, float]]:
        """Return scores of every held-out view by name; none where the rule is a constant.

        Args:
            metering: from `fit`.
            score: (name, linear, exposure, photograph, mask, alpha) -> scores by name.
        """
        if not metering.rule.meters:
            return {}

        def judged(view: _Kept) -> dict[str, float]:
            exposure = metering.exposure(view.readings)
            given = (view.linear.read(), exposure, view.photograph.read(), view.mask.read())
            alpha = None if view.alpha is None else view.alpha.read()
            return {**score(view.name, *given, alpha), "exposure": exposure}

        names = [view.name for view in self._kept]
        return dict(zip(names, map_in_order(judged, self._kept), strict=True))
