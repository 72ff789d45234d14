"""How well somebody else's splats show photographs: as they are, and by one gain for each."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import PhotometryConfig, RenderConfig
from p2gs_jax.evaluate.alignment import with_fitted_exposure
from p2gs_jax.evaluate.view_scores import Collector, view_scores
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import GAMMA_SRGB, Gaussians, Scene

AS_IT_IS = DisplayTransform(1.0, GAMMA_SRGB, PhotometryConfig(curve="linear"))


class ForeignScores(NamedTuple):
    """Scores of a model of display colours.

    Attributes:
        summary: `test` and `train`, each with `as_it_is` and `exposure_fitted` (one gain on display
            values, solved from the photograph), as in `metrics.json`.
        agreement: median over the views of the correlation of the grey values of render and
            photograph, which no gain changes.
    """

    summary: dict[str, Any]
    agreement: float


def score_foreign(
    gaussians: Gaussians, scene: Scene, store: ImageStore, cfg: RenderConfig
) -> ForeignScores:
    """Render and judge all views of a scene.

    Args:
        gaussians: display colours.
        scene: views and their splits.
        store: photographs.
        cfg: of a viewer of display colours.
    """
    render, alive = make_renderer(cfg), jnp.ones(gaussians.capacity, bool)
    rows = {split: (Collector(), Collector()) for split in ("train", "test")}
    agree = []
    for index, view in enumerate(scene.views):
        photograph, mask = store.get(index, 1)
        linear = np.asarray(render(gaussians, alive, camera_of(store, index)).linear)
        gained = with_fitted_exposure(AS_IT_IS, linear, photograph, mask)
        for collector, how in zip(rows[view.split], (AS_IT_IS, gained), strict=True):
            shown = develop(linear, how)
            collector.add(view.name, view_scores(None, shown, photograph, mask))
        agree.append(_correlation(linear.mean(-1)[mask > 0], photograph.mean(-1)[mask > 0]))
    return ForeignScores(
        {
            split: {"as_it_is": plain.summary(), "exposure_fitted": gained.summary()}
            for split, (plain, gained) in rows.items()
            if plain.rows
        },
        float(np.median(agree)),
    )


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two samples; 0 where one does not vary."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0 else 0.0
