"""What is judged of drives only; each part of `metrics.json` has a module of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float32

from p2gs_jax.core.numerics import on_device
from p2gs_jax.evaluate.array_store import ArrayStore
from p2gs_jax.evaluate.lidar_depth import DepthErrors, depth_errors, sized, summary
from p2gs_jax.evaluate.novel_views import SHIFTS, Surface, picked, shifted, unseen_share
from p2gs_jax.evaluate.region_scores import parts_of
from p2gs_jax.evaluate.unexplained import Residuals, Unexplained, shares_by_view
from p2gs_jax.render.warp import OPAQUE
from p2gs_jax.scene.drives.objects import (
    object_mask,
)
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.rigid import left_of_way
from p2gs_jax.types import Camera, Render, Scene, View


def is_drive(scene: Scene) -> bool:
    """Return whether views have times: those of drives do."""
    return any(view.time is not None for view in scene.views)


def masks_of_parts(
    scene: Scene, index: int, mask: Float32[np.ndarray, "h w"]
) -> dict[str, Float32[np.ndarray, "h w"]]:
    """Return the masks of a view's whole, static and moving pixels, those that have any.

    Args:
        scene: its views and boxes.
        index: row of the view.
        mask: 1 = use.
    """
    height, width = mask.shape
    return parts_of(mask, object_mask(scene.views[index], scene.objects, width, height))


class DriveScores:
    """Collects rendered views, and judges them together.

    Attributes:
        unexplained: after `summary`: what no static scene explains, by row of the view.
    """

    def __init__(
        self,
        scene: Scene,
        store: ImageStore,
        render: Callable[[Camera], Render],
        arrays: ArrayStore | None = None,
    ):
        """Begin empty.

        Args:
            scene: a drive.
            store: photographs.
            render: of a camera, with depth.
            arrays: keeps what all views need to the end; None: memory does.
        """
        self._scene, self._store, self._render = scene, store, render
        self._residuals = Residuals(scene.views, arrays)
        self._depths: dict[int, DepthErrors] = {}
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
        if self._scene.views[index].split == "train":
            K = self._store.camera(index)[1]
            self._residuals.add(index, ldr, photograph, mask, _surface(depth, alpha), K)
        if self._scene.lidar is not None:
            given = (self._view(index), depth, alpha, mask)
            found = depth_errors(self._scene.lidar, self._scene.objects, *given)
            if len(found.error):
                self._depths[index] = found

    def summary(self) -> dict:
        """Return the parts of `metrics.json`."""
        self.unexplained = self._residuals.find()
        shares = shares_by_view(self._scene, self.unexplained)
        out = {"unexplained": shares, "novel_views": self._novel()}
        views = self._scene.views
        held_out = [d for row, d in self._depths.items() if views[row].split == "test"]
        depth = {"all": summary(list(self._depths.values())), "held_out": summary(held_out)}
        return out if not depth["all"] else {**out, "depth": depth}

    def _novel(self) -> list[dict]:
        """Return what views from beside the way show, a row for every distance."""
        left, known = left_of_way(self._scene.views), self._residuals.surfaces()
        # Where there is a sweep, depth can be judged too.
        pool = sorted(self._depths) or list(range(len(self._scene.views)))
        rows = []
        for metres in SHIFTS:
            shares, depths = [], []
            for index in (pool[k] for k in picked(len(pool))):
                view = self._view(index)
                viewmat = shifted(view.viewmat, left[index], metres)
                result = self._render(self._camera(view, viewmat))
                depth, alpha = np.asarray(result.depth), np.asarray(result.alpha)
                surface = Surface(_surface(depth, alpha), viewmat, view.K)
                shares.append(unseen_share(surface, known))
                if self._scene.lidar is not None:
                    moved = dataclasses.replace(view, viewmat=viewmat)
                    lidar, things = self._scene.lidar, self._scene.objects
                    depths.append(depth_errors(lidar, things, moved, depth, alpha))
            row = {"shift_m": metres, "unseen": float(np.mean(shares)), "views": len(shares)}
            rows.append({**row, "depth": summary(depths)})
        return rows

    def _view(self, index: int) -> View:
        """Return a view at the size of its render."""
        _, K, width, height = self._store.camera(index)
        return sized(self._scene.views[index], K, width, height)

    def _camera(self, view: View, viewmat: Float32[np.ndarray, "4 4"]) -> Camera:
        """Return a camera elsewhere at the time of a view."""
        moving, objects = self._store.moving, None
        if moving is not None and view.time is not None:
            objects = moving.placement(viewmat, view.time)
        return Camera(on_device(viewmat), on_device(view.K), view.width, view.height, objects)


def _surface(
    depth: Float32[np.ndarray, "h w"], alpha: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return the expected depth where a render is opaque, else 0."""
    opaque = alpha > OPAQUE
    return np.where(opaque, depth / np.maximum(alpha, OPAQUE), 0).astype(np.float32)
