"""What is judged of drives only; each part of `metrics.json` has a module of its own."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from p2gs_jax.evaluate.moving import MovingScores
from p2gs_jax.evaluate.unexplained import Residuals, Unexplained
from p2gs_jax.render.warp import OPAQUE
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Scene


def is_drive(scene: Scene) -> bool:
    """Return whether views have times: those of drives do."""
    return any(view.time is not None for view in scene.views)


class DriveScores:
    """Collects rendered views, and judges them together.

    Attributes:
        unexplained: after `summary`: what no static scene explains, by row of the view.
    """

    def __init__(self, scene: Scene, store: ImageStore):
        """Begin empty.

        Args:
            scene: a drive.
            store: photographs.
        """
        self._scene, self._store = scene, store
        self._residuals = Residuals(scene.views)
        self._moving = MovingScores(scene)
        self.unexplained: dict[int, Unexplained] = {}

    def add(
        self,
        index: int,
        ldr: Float32[np.ndarray, "h w 3"],
        photograph: Float32[np.ndarray, "h w 3"],
        mask: Float32[np.ndarray, "h w"],
        depth: Float32[np.ndarray, "h w"],
        alpha: Float32[np.ndarray, "h w"],
    ) -> None:
        """Take a view.

        Args:
            index: its row.
            ldr: its render, under its own exposure or one fitted to the photograph.
            photograph: display values.
            mask: 1 = use.
            depth: alpha-weighted camera z.
            alpha: opacity.
        """
        self._moving.add(index, ldr, photograph, mask)
        surface = np.where(alpha > OPAQUE, depth / np.maximum(alpha, OPAQUE), 0)
        if self._scene.views[index].split == "train":
            K = self._store.camera(index)[1]
            self._residuals.add(index, ldr, photograph, mask, surface.astype(np.float32), K)

    def summary(self) -> dict:
        """Return the parts of `metrics.json`."""
        self.unexplained = self._residuals.find()
        return {"unexplained": self._shares(), **self._moving.summary()}

    def _shares(self) -> dict:
        """Return shares of pixels by view, and their mean."""
        views = self._scene.views
        shares = {views[row].name: found.share for row, found in self.unexplained.items()}
        return {"share": float(np.mean(list(shares.values()))), "per_view": shares}
