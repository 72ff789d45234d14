"""Inputs of a step besides its state: photographs, a second view, settings from the schedule.

All of them depend only on the seed, the step number and the progress.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float32, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import device_bytes, on_host
from p2gs_jax.core.streams import Stream, device_seed, generator, view_order
from p2gs_jax.render.capacity import canvases
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.train import schedule
from p2gs_jax.train.exposure_loss import ColorPairs, Partner
from p2gs_jax.train.update import Controls
from p2gs_jax.types import Batch, Camera, Measured

Tree = TypeVar("Tree")

# Number of pairs that the relative-exposure loss compares in a step.
PAIRS_PER_STEP = 4096
# Share of a GPU's memory that photographs of one level may use; others are uploaded in each step.
RESIDENT = 0.25

# Pixels, mask, and alpha or None.
Photograph = tuple[Any, Any, Any]


class TrainingViews:
    """Photographs of the training views at any level of the coarse-to-fine schedule.

    `rows` are rows in the scene, in the order of `Photometry`; `seed` sets the order of every
    epoch; `measured` holds the measured depths of each view, or None. `resident` keeps photographs
    on a GPU; it must be off for steps of several views, which stack photographs on the host.
    `padded` pads photographs to `canvases`; learned corrections, by pixel position, need it off.
    """

    def __init__(
        self,
        store: ImageStore,
        rows: Sequence[int],
        seed: int,
        measured: Sequence[Measured] | None = None,
        resident: bool = True,
        padded: bool = True,
    ):
        self.store, self.rows = store, tuple(rows)
        self.seed, self.measured = seed, measured
        self._batches = functools.lru_cache(4)(self._epoch)
        all_sizes = store.sizes
        sizes = [all_sizes[row] for row in rows]
        canvas_of = canvases(sizes) if padded else {size: size for size in sizes}
        self._kinds = [canvas_of[size] for size in sizes]
        # One row of every size, by its canvas.
        self._alike: dict[tuple[int, int], dict[tuple[int, int], int]] = {}
        for size, kind, row in zip(sizes, self._kinds, rows, strict=True):
            self._alike.setdefault(kind, {})[size] = row
        self._budget = RESIDENT * device_bytes() if resident else 0.0
        # Photographs on the device by row, their level, and the bytes left for others.
        self._resident: dict[int, Photograph] = {}
        self._level, self._left = 0, 0.0

    def __len__(self) -> int:
        return len(self.rows)

    def indices_at(self, step: int, count: int) -> tuple[int, ...]:
        """Return the rows in `Photometry` of the `count` views of a step.

        Their images have one size. `step` is the number of earlier views.
        """
        epoch, position = divmod(step // count, len(self._batches(0, count)))
        return self._batches(epoch, count)[position]

    def _epoch(self, epoch: int, count: int) -> list[tuple[int, ...]]:
        return batches_of(view_order(self.seed, epoch, len(self.rows)), self._kinds, count)

    def first_of_sizes(self, step: int, count: int) -> list[int]:
        """Return the next step, from `step` on, for every canvas size."""
        steps = range(step, step + count * len(self._batches(0, count)), count)
        kinds = [self._kinds[self.indices_at(k, count)[0]] for k in steps]
        return [steps[kinds.index(kind)] for kind in dict.fromkeys(kinds)]

    def partner_at(self, step: int, index: int) -> int:
        """Return a second view, drawn at random; it differs from the first if there are two."""
        rng = generator(self.seed, Stream.PARTNER, step)
        count = len(self.rows)
        return (index + int(rng.integers(1, max(count, 2)))) % count

    def prefetch(self, index: int, shrink: int) -> None:
        """Begin to decode a view in the background, unless it is on the device."""
        if shrink != self._level or self.rows[index] not in self._resident:
            self.store.prefetch(self.rows[index], shrink)

    def camera(self, index: int, shrink: int) -> Camera:
        """Return the camera of a training view at a level, on the host, for its whole canvas."""
        row = self.rows[index]
        viewmat, K = self.store.camera(row, shrink)[:2]
        return on_host(Camera, viewmat, K, *self._canvas(index, shrink), self.store.placement(row))

    def _canvas(self, index: int, shrink: int) -> tuple[int, int]:
        """Return the width and height of the canvas of a view at a level, pixels."""
        rows = self._alike[self._kinds[index]].values()
        widths, heights = zip(*(self.store.camera(row, shrink)[2:] for row in rows), strict=True)
        return max(widths), max(heights)

    def batch(self, index: int, shrink: int, step: int = 0) -> Batch:
        """Return a training view on the host, from which a compiled step reads it.

        On a GPU, pixels of a level stay on the device up to a share of its memory (RESIDENT).
        `step` seeds the random background, if there is one.
        """
        camera, measured, size = self.camera(index, shrink), None, None
        ldr, mask, alpha = self._photograph(index, camera, shrink)
        if self.measured is not None:
            measured = self.measured[index]
        if len(self._alike[self._kinds[index]]) > 1:
            size = np.array(self.store.camera(self.rows[index], shrink)[2:], np.float32)
            if measured is not None:
                places = measured.places * (size / [camera.width, camera.height])
                measured = dataclasses.replace(measured, places=places.astype(np.float32))
        fields = (camera, ldr, mask, np.int32(index), measured, alpha, self._backdrop(step), size)
        return on_host(Batch, *fields)

    def _photograph(self, index: int, camera: Camera, shrink: int) -> Photograph:
        """Return the pixels, mask and alpha of a view on its canvas, in their stored types."""
        row = self.rows[index]
        if shrink != self._level:
            self._resident.clear()
            self._level, self._left = shrink, self._budget
        if row in self._resident:
            return self._resident[row]
        pixels = (*self.store.stored(row, shrink), self.store.alpha(row, shrink))
        canvas = (camera.height, camera.width)
        pixels = jax.tree.map(lambda a: _padded(canvas, a), pixels)
        size = sum(a.nbytes for a in jax.tree.leaves(pixels))
        if size <= self._left:
            self._left -= size
            pixels = self._resident[row] = jax.device_put(pixels)
        return pixels

    def _backdrop(self, step: int) -> Float32[np.ndarray, " 3"] | None:
        if not self.store.random_backdrop:
            return self.store.backdrop
        return generator(self.seed, Stream.BACKDROP, step).random(3).astype(np.float32)


def _padded(canvas: tuple[int, int], image: np.ndarray) -> np.ndarray:
    """Return an image padded with zeros on the right and below to the canvas (h, w)."""
    widths = [(0, most - n) for most, n in zip(canvas, image.shape, strict=False)]
    return np.pad(image, widths + [(0, 0)] * (image.ndim - 2)) if np.any(widths) else image


def batches_of(
    order: Int[np.ndarray, " v"], kinds: Sequence[Hashable], count: int
) -> list[tuple[int, ...]]:
    """Return an epoch as batches of `count` views of one kind, with each view at least once.

    Views of a kind have images of one size, so one program serves them; they keep their order. A
    last incomplete batch is filled with the first views of its kind. Batches are in the order of
    their first views.
    """
    by_kind: dict[Hashable, list[int]] = {}
    for view in order:
        by_kind.setdefault(kinds[view], []).append(int(view))
    place = {int(view): at for at, view in enumerate(order)}
    batches: list[tuple[int, ...]] = []
    for views in by_kind.values():
        whole = np.resize(views, -(-len(views) // count) * count)
        batches += [tuple(row.tolist()) for row in whole.reshape(-1, count)]
    return sorted(batches, key=lambda batch: place[batch[0]])


def stacked(trees: Sequence[Tree]) -> Tree:
    """Return host records stacked along a new first axis; photographs keep the finer type."""
    return jax.tree.map(lambda *arrays: np.stack(_of_one_type(arrays)), *trees)


def _of_one_type(arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return arrays of one type: 8-bit pixels become 16-bit if others are, with 255 as 65535."""
    arrays = [np.asarray(a) for a in arrays]
    if {a.dtype for a in arrays} == {np.dtype(np.uint8), np.dtype(np.uint16)}:
        return [a.astype(np.uint16) * 257 if a.dtype == np.uint8 else a for a in arrays]
    return arrays


class Inputs(NamedTuple):
    """Arguments of a step, on the host; arguments of several views are stacked."""

    batch: Batch
    partner: Partner
    controls: Controls

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.batch.camera.width, self.batch.camera.height


def controls_at(progress: float, per_step: float, visible_share: float, cfg: FitConfig) -> Controls:
    """Return the settings of the schedule at this progress.

    `per_step` is the progress of one step; `visible_share` is the share of the scene that a view
    shows.
    """
    degree = schedule.sh_degree_at(progress, cfg.train, cfg.render.sh_degree)
    rate = schedule.rate_factor(per_step, visible_share, cfg.optimizer.full_rate_updates)
    values = (np.float32(progress), np.int32(degree), np.float32(rate))
    return on_host(Controls, *values, device_seed(cfg.train.seed))


def inputs_at(
    step: int,
    controls: Controls,
    shrink: int,
    views: TrainingViews,
    pairs: ColorPairs | None,
    cfg: FitConfig,
) -> Inputs:
    """Return the inputs of a step.

    `step` is the number of earlier views; `shrink` is the factor by which images are shrunk;
    `pairs` are colours of the same points in two views, for the relative-exposure loss, or None.
    """
    rows = views.indices_at(step, cfg.train.batch)
    each = [
        (views.batch(row, shrink, step + k), partner_at(step + k, row, views, pairs, cfg))
        for k, row in enumerate(rows)
    ]
    if len(each) == 1:
        return Inputs(*each[0], controls)
    batches, partners = zip(*each, strict=True)
    return Inputs(stacked(batches), stacked(partners), controls)


def partner_at(
    step: int, index: int, views: TrainingViews, pairs: ColorPairs | None, cfg: FitConfig
) -> Partner:
    """Return the partner of a step's view, with the parts that the form of the loss needs.

    `index` is the row of the view; for the other arguments see `inputs_at`.
    """
    if cfg.loss.relative_exposure.weight is None:
        return on_host(Partner, np.int32(0))
    drawn = None
    if pairs is not None:
        count = pairs.views_i.shape[0]
        rng = generator(cfg.train.seed, Stream.STEP_PAIRS, step)
        pick = rng.integers(0, count, min(PAIRS_PER_STEP, count))
        drawn = jax.tree.map(lambda a: np.asarray(a)[pick], pairs)
    return on_host(Partner, np.int32(views.partner_at(step, index)), drawn)
