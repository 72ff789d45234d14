"""Training views on their way to the device: order, prefetch, resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.streams import Stream, generator, view_order
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.train.batches import batches_of
from p2gs_jax.types import Batch, Camera, Measured


class TrainingViews:
    """Photographs of the training views at any level of the coarse-to-fine schedule.

    Args:
        store: decodes and caches photographs.
        rows: rows of the training views in the scene, in the order of `Photometry`.
        seed: decides the order of every epoch.
        overlaps: for every training view the ones that show the same surfaces; None: all others.
        measured: of every training view the depths that the loss compares with, or None.
    """

    def __init__(
        self,
        store: ImageStore,
        rows: Sequence[int],
        seed: int,
        overlaps: Sequence[Int[np.ndarray, " k"]] | None = None,
        measured: Sequence[Measured] | None = None,
    ):
        self.store = store
        self.rows = tuple(rows)
        self.seed = seed
        self.overlaps = overlaps
        self.measured = measured
        self._orders: dict[int, np.ndarray] = {}
        self._hidden: dict[int, Bool[np.ndarray, "a b"]] = {}
        self.leave_out(())

    def __len__(self) -> int:
        return len(self.rows)

    def leave_out(self, without: Sequence[int]) -> None:
        """Take some views out of the order of steps from here on, or all back in.

        Args:
            without: which, as rows in `Photometry`; none takes all back in.
        """
        self._kept = np.setdiff1d(np.arange(len(self.rows)), np.asarray(without, int))
        self._orders = {}
        self._per_epoch: dict[int, int] = {}
        self._batched: tuple[int, int, list[tuple[int, ...]]] = (-1, 0, [])

    def hide(self, masks: Mapping[int, Bool[np.ndarray, "a b"]]) -> None:
        """Leave pixels out of all batches from here on, and take back those left out before.

        Args:
            masks: which, at any resolution, by row in `Photometry`; views that are missing are
                shown whole.
        """
        self._hidden = {row: mask for row, mask in masks.items() if mask.any()}

    def index_at(self, step: int) -> int:
        """Return the row in `Photometry` of the view of a step; every epoch is a permutation."""
        epoch, position = divmod(step, len(self._kept))
        if epoch not in self._orders:
            order = view_order(self.seed, epoch, len(self.rows))
            self._orders = {epoch: order[np.isin(order, self._kept)]}
        return int(self._orders[epoch][position])

    def indices_at(self, step: int, count: int) -> tuple[int, ...]:
        """Return the rows of the views that a step of so many takes; they have one size.

        Args:
            step: views taken before it.
            count: views of a step.
        """
        if count == 1:
            return (self.index_at(step),)
        if count not in self._per_epoch:
            self._per_epoch[count] = len(self._batches(0, count))
        epoch, position = divmod(step // count, self._per_epoch[count])
        return self._batches(epoch, count)[position]

    def _batches(self, epoch: int, count: int) -> list[tuple[int, ...]]:
        if self._batched[:2] != (epoch, count):
            views = [self.store.views[row] for row in self.rows]
            kinds = [(v.width, v.height) for v in views]
            order = view_order(self.seed, epoch, len(self.rows))
            order = order[np.isin(order, self._kept)]
            self._batched = (epoch, count, batches_of(order, kinds, count))
        return self._batched[2]

    def partner_at(self, step: int, index: int) -> int:
        """Return a second view, different from that of the step where there are two.

        Drawn from those that overlap it, where it is known which do; never one that is left out.

        Args:
            step: draws it.
            index: row of the step's view.
        """
        rng = generator(self.seed, Stream.PARTNER, step)
        if self.overlaps is not None:
            overlapping = self.overlaps[index]
            overlapping = overlapping[np.isin(overlapping, self._kept)]
            if len(overlapping):
                return int(rng.choice(overlapping))
        kept = self._kept
        place = int(np.searchsorted(kept, index)) + int(rng.integers(1, max(len(kept), 2)))
        return int(kept[place % len(kept)])

    def prefetch(self, index: int, shrink: int) -> None:
        """Begin decoding a view in the background."""
        self.store.prefetch(self.rows[index], shrink)

    def camera(self, index: int, shrink: int) -> Camera:
        """Return the camera of a training view at a level, on the host."""
        row = self.rows[index]
        return on_host(Camera, *self.store.camera(row, shrink), self.store.placement(row))

    def batch(self, index: int, shrink: int, step: int = 0, *, decoded: bool = True) -> Batch:
        """Return a training view, on the host: a compiled step takes it from there.

        Args:
            index: row in `Photometry`.
            shrink: factor by which images are shrunk.
            step: draws the background, where every step has another.
            decoded: off: with black pixels, where another process composites it.
        """
        row = self.rows[index]
        if not decoded:
            return self._elsewhere(index, shrink, step)
        ldr, mask = self.store.stored(row, shrink)
        measured = None if self.measured is None else self.measured[index]
        if index in self._hidden:
            hidden = self._hidden[index]
            mask = mask & ~resized(hidden, mask.shape[1], mask.shape[0])
            measured = None if measured is None else _outside(measured, hidden)
        given = (self.camera(index, shrink), ldr, mask, np.int32(index), measured)
        return on_host(Batch, *given, self.store.alpha(row, shrink), self._backdrop(step))

    def _elsewhere(self, index: int, shrink: int, step: int) -> Batch:
        camera = self.camera(index, shrink)
        size = camera.height, camera.width
        measured = None if self.measured is None else self.measured[index]
        alpha = None if self.store.backdrop is None else np.zeros(size, np.uint16)
        pixels = np.zeros((*size, 3), np.uint16), np.zeros(size, bool)
        given = (camera, *pixels, np.int32(index), measured, alpha)
        return on_host(Batch, *given, self._backdrop(step))

    def _backdrop(self, step: int) -> Float32[np.ndarray, " 3"] | None:
        if not self.store.random_backdrop:
            return self.store.backdrop
        return generator(self.seed, Stream.BACKDROP, step).random(3).astype(np.float32)


def resized(
    mask: Bool[np.ndarray, "a b"], width: int, height: int
) -> Bool[np.ndarray, "height width"]:
    """Return a mask at another size: at each pixel what is nearest to it."""
    small = mask.astype(np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def _outside(measured: Measured, hidden: Bool[np.ndarray, "a b"]) -> Measured:
    """Return depths without those where pixels are left out."""
    places, size = np.asarray(measured.places), np.array(hidden.shape[::-1])
    column, row = np.clip((places * size).astype(int), 0, size - 1).T
    depths = np.where(hidden[row, column], np.float32(0), measured.depths)
    return on_host(Measured, places, depths)
