"""What a step is given beside its state: photographs, a second view, the schedule.

All of it follows from the seed and the step number.
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

# Observations that a step compares.
PAIRS_PER_STEP = 4096
# Share of a GPU's memory that photographs of one level may take; others are uploaded in every step.
RESIDENT = 0.25

# Pixels, mask, and alpha where there is one.
Photograph = tuple[Any, Any, Any]


class TrainingViews:
    """Photographs of the training views at any level of the coarse-to-fine schedule.

    `rows` are rows in the scene, in the order of `Photometry`; `seed` decides the order of every
    epoch; `measured` are the depths that the loss compares each view with, or None. A step of
    several views stacks their photographs on the host, where they must not be `resident`. Of many
    sizes, photographs lie on `canvases`, unless `padded` is off: learned corrections know places.
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
        every = store.sizes
        sizes = [every[row] for row in rows]
        on = canvases(sizes) if padded else {size: size for size in sizes}
        self._kinds = [on[size] for size in sizes]
        # A row of every size, by the canvas.
        self._alike: dict[tuple[int, int], dict[tuple[int, int], int]] = {}
        for size, kind, row in zip(sizes, self._kinds, rows, strict=True):
            self._alike.setdefault(kind, {})[size] = row
        self._room = RESIDENT * device_bytes() if resident else 0.0
        # Photographs on the device by row, their level, and the bytes that are left for others.
        self._resident: dict[int, Photograph] = {}
        self._level, self._left = 0, 0.0

    def __len__(self) -> int:
        return len(self.rows)

    def indices_at(self, step: int, count: int) -> tuple[int, ...]:
        """Return the rows in `Photometry` of the views that a step of `count` views takes.

        They have images of one size. `step` counts the views taken before it.
        """
        epoch, position = divmod(step // count, len(self._batches(0, count)))
        return self._batches(epoch, count)[position]

    def _epoch(self, epoch: int, count: int) -> list[tuple[int, ...]]:
        return batches_of(view_order(self.seed, epoch, len(self.rows)), self._kinds, count)

    def first_of_sizes(self, step: int, count: int) -> list[int]:
        """Return the next step, from this one on, for every size that images are compiled at."""
        steps = range(step, step + count * len(self._batches(0, count)), count)
        kinds = [self._kinds[self.indices_at(k, count)[0]] for k in steps]
        return [steps[kinds.index(kind)] for kind in dict.fromkeys(kinds)]

    def partner_at(self, step: int, index: int) -> int:
        """Return a second view, different from that of the step where there are two."""
        rng = generator(self.seed, Stream.PARTNER, step)
        count = len(self.rows)
        return (index + int(rng.integers(1, max(count, 2)))) % count

    def prefetch(self, index: int, shrink: int) -> None:
        """Begin decoding a view in the background, unless it is on the device."""
        if shrink != self._level or self.rows[index] not in self._resident:
            self.store.prefetch(self.rows[index], shrink)

    def camera(self, index: int, shrink: int) -> Camera:
        """Return the camera of a training view at a level, on the host, over its whole canvas."""
        row = self.rows[index]
        viewmat, K = self.store.camera(row, shrink)[:2]
        return on_host(Camera, viewmat, K, *self._canvas(index, shrink), self.store.placement(row))

    def _canvas(self, index: int, shrink: int) -> tuple[int, int]:
        """Return the width and height that a view is compiled at, at a level."""
        rows = self._alike[self._kinds[index]].values()
        widths, heights = zip(*(self.store.camera(row, shrink)[2:] for row in rows), strict=True)
        return max(widths), max(heights)

    def batch(self, index: int, shrink: int, step: int = 0) -> Batch:
        """Return a training view, on the host: a compiled step takes it from there.

        On a GPU the pixels stay on the device, as long as those of a level find room there. `step`
        draws the background, where every step has another.
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
        given = (camera, ldr, mask, np.int32(index), measured, alpha, self._backdrop(step), size)
        return on_host(Batch, *given)

    def _photograph(self, index: int, camera: Camera, shrink: int) -> Photograph:
        """Return the pixels, mask and alpha of a view on its canvas, as they are stored."""
        row = self.rows[index]
        if shrink != self._level:
            self._resident.clear()
            self._level, self._left = shrink, self._room
        if row in self._resident:
            return self._resident[row]
        pixels = (*self.store.stored(row, shrink), self.store.alpha(row, shrink))
        canvas = (camera.height, camera.width)
        pixels = jax.tree.map(lambda a: _laid_on(canvas, a), pixels)
        size = sum(a.nbytes for a in jax.tree.leaves(pixels))
        if size <= self._left:
            self._left -= size
            pixels = self._resident[row] = jax.device_put(pixels)
        return pixels

    def _backdrop(self, step: int) -> Float32[np.ndarray, " 3"] | None:
        if not self.store.random_backdrop:
            return self.store.backdrop
        return generator(self.seed, Stream.BACKDROP, step).random(3).astype(np.float32)


def _laid_on(canvas: tuple[int, int], image: np.ndarray) -> np.ndarray:
    """Return an image with zeros to its right and below, where a canvas (h, w) is larger."""
    wider = [(0, most - n) for most, n in zip(canvas, image.shape, strict=False)]
    return np.pad(image, wider + [(0, 0)] * (image.ndim - 2)) if np.any(wider) else image


def batches_of(
    order: Int[np.ndarray, " v"], kinds: Sequence[Hashable], count: int
) -> list[tuple[int, ...]]:
    """Return an epoch as batches of views that one program can take, each view once at least.

    Views of a kind have images of one size and stay in their order. What is left over of a kind is
    filled up from its beginning; batches take the turn of their first view.
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
    """Return host records as one, along a new first axis; photographs keep the finer type."""
    return jax.tree.map(lambda *arrays: np.stack(_of_one_type(arrays)), *trees)


def _of_one_type(arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return pixels of 8 bits as of 16 where others are: 255 and 65535 both stand for 1."""
    arrays = [np.asarray(a) for a in arrays]
    if {a.dtype for a in arrays} == {np.dtype(np.uint8), np.dtype(np.uint16)}:
        return [a.astype(np.uint16) * 257 if a.dtype == np.uint8 else a for a in arrays]
    return arrays


class Inputs(NamedTuple):
    """Arguments of a step, all on the host; those of several views are stacked."""

    batch: Batch
    partner: Partner
    controls: Controls

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.batch.camera.width, self.batch.camera.height


def controls_at(progress: float, pace: float, shown: float, cfg: FitConfig) -> Controls:
    """Return what the schedule says at this point of a run.

    `pace` is the progress of one step, `shown` the share of the scene that a view shows.
    """
    degree = schedule.sh_degree_at(progress, cfg.train, cfg.render.sh_degree)
    rate = schedule.rate_factor(pace, shown, cfg.optimizer.settled)
    given = (np.float32(progress), np.int32(degree), np.float32(rate))
    return on_host(Controls, *given, device_seed(cfg.train.seed))


def inputs_at(
    step: int,
    controls: Controls,
    shrink: int,
    views: TrainingViews,
    pairs: ColorPairs | None,
    cfg: FitConfig,
) -> Inputs:
    """Return the inputs of a step.

    `step` counts the views taken before it, `shrink` is the factor by which images are shrunk,
    `pairs` are corresponding observations, where the relative-exposure loss compares photographs.
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
    """Return the partner of a step's view, as much of it as the reading of the loss needs.

    `index` is the row of the view; for the others see `inputs_at`.
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
