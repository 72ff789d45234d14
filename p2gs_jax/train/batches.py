"""Which views a step of several takes together, and their inputs as one."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TypeVar

import jax
import numpy as np
from jaxtyping import Int

Tree = TypeVar("Tree")


def batches_of(
    order: Int[np.ndarray, " v"], kinds: Sequence[Hashable], count: int
) -> list[tuple[int, ...]]:
    """Return an epoch as batches of views that one program can take, each view once at least.

    Views of a kind stay in their order. What is left over of a kind is filled up from its
    beginning; batches take the turn of their first view.

    Args:
        order: the views of the epoch.
        kinds: of every view; those of one kind have images of one size.
        count: views of a batch.
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
