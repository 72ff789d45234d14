"""Training views on their way to the device: order, prefetch, resolution."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

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
        measured: of every training view the depths that the loss compares with, or None.
    """

    def __init__(
        self,
        store: ImageStore,
        rows: Sequence[int],
        seed: int,
        measured: Sequence[Measured] | None = None,
    ):
        self.store = store
        self.rows = tuple(rows)
        self.seed = seed
        self.measured = measured
        self._orders: dict[int, np.ndarray] = {}
        self._per_epoch: dict[int, int] = {}
        self._batched: tuple[int, int, list[tuple[int, ...]]] = (-1, 0, [])

    def __len__(self) -> int:
        return len(self.rows)

    def index_at(self, step: int) -> int:
        """Return the row in `Photometry` of the view of a step; every epoch is a permutation."""
        epoch, position = divmod(step, len(self.rows))
        if epoch not in self._orders:
            self._orders = {epoch: view_order(self.seed, epoch, len(self.rows))}
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
            self._batched = (epoch, count, batches_of(order, kinds, count))
        return self._batched[2]

    def partner_at(self, step: int, index: int) -> int:
        """Return a second view, different from that of the step where there are two.

        Args:
            step: draws it.
            index: row of the step's view.
        """
        rng = generator(self.seed, Stream.PARTNER, step)
        count = len(self.rows)
        return (index + int(rng.integers(1, max(count, 2)))) % count

    def prefetch(self, index: int, shrink: int) -> None:
        """Begin decoding a view in the background."""
        self.store.prefetch(self.rows[index], shrink)

    def camera(self, index: int, shrink: int) -> Camera:
        """Return the camera of a training view at a level, on the host."""
        row = self.rows[index]
        return on_host(Camera, *self.store.camera(row, shrink), self.store.placement(row))

    def batch(self, index: int, shrink: int, step: int = 0) -> Batch:
        """Return a training view, on the host: a compiled step takes it from there.

        Args:
            index: row in `Photometry`.
            shrink: factor by which images are shrunk.
            step: draws the background, where every step has another.
        """
        row = self.rows[index]
        ldr, mask = self.store.stored(row, shrink)
        measured = None if self.measured is None else self.measured[index]
        given = (self.camera(index, shrink), ldr, mask, np.int32(index), measured)
        return on_host(Batch, *given, self.store.alpha(row, shrink), self._backdrop(step))

    def _backdrop(self, step: int) -> Float32[np.ndarray, " 3"] | None:
        if not self.store.random_backdrop:
            return self.store.backdrop
        return generator(self.seed, Stream.BACKDROP, step).random(3).astype(np.float32)
