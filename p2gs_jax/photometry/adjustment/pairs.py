"""Sums over pairs of observations of a point: what eliminating the points couples."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.photometry.adjustment.matrices import Entries

# Pairs whose products are formed at once: they stay in the cache.
CHUNK = 1 << 15


class Pairs:
    """Every pair of observations of a row once, each with itself included.

    Entries of the sums exist only where two views share a point: with thousands of views, those
    are few of all.

    Attributes:
        order: observations sorted by row: the two of a pair then lie close together.
        view_count: number of views.
    """

    def __init__(self, row: Int[np.ndarray, " o"], views: Int[np.ndarray, " o"], view_count: int):
        self.order = np.argsort(row, kind="stable")
        self.view_count = view_count
        here, seen_by = row[self.order], views[self.order]
        at = np.arange(len(here))
        # Every entry with itself and those after it that equal it.
        following = np.searchsorted(here, here, side="right") - at
        self._first = np.repeat(at, following).astype(np.int32)
        ends = np.cumsum(following) - following
        offset = np.arange(len(self._first)) - np.repeat(ends, following)
        self._second = (self._first + offset).astype(np.int32)
        del offset
        keys = seen_by[self._first] * np.int64(view_count) + seen_by[self._second]
        unique, place = np.unique(keys, return_inverse=True)
        self._place = place.astype(np.int32)
        self._rows, self._columns = unique // max(view_count, 1), unique % max(view_count, 1)

    def __len__(self) -> int:
        return len(self._first)

    def sums(
        self,
        factors: list[Float[np.ndarray, "o f"]],
        shared: list[list[tuple[int, int]]],
        kind: type[np.floating] = np.float64,
    ) -> Entries:
        """Return the sum over rows of outer products of per-view vectors: (x V, x V).

        Args:
            factors: of each of x parameters, what its view contributes, in f components.
            shared: for every two parameters the components that they have in common, as pairs of
                places in their factors: `shared[x * len(factors) + y]`.
            kind: of the products. In the rounds float32: there the matrix decides how fast they
                converge, never where they end. Standard errors need float64: what joins groups of
                views by a few dark points is less than the rounding of what joins the views of a
                group.
        """
        count, views = len(factors), self.view_count
        parts = [f[self.order].astype(kind) for f in factors]
        used = [k for k, common in enumerate(shared) if common]
        totals = np.zeros((len(used), len(self._rows)))
        # Not fewer at once than half of the entries they are added to.
        chunk = max(CHUNK, len(self._rows) // 2)
        for start in range(0, len(self._first), chunk):
            part = slice(start, start + chunk)
            first, second, place = self._first[part], self._second[part], self._place[part]
            # A product of an observation with itself is counted twice below.
            half = np.where(first == second, kind(0.5), kind(1.0))
            left = [np.take(p, first, 0) * half[:, None] for p in parts]
            right = [np.take(p, second, 0) for p in parts]
            for total, k in zip(totals, used, strict=True):
                x, y = divmod(k, count)
                a, b = zip(*shared[k], strict=True)
                products = np.einsum("pf,pf->p", left[x][:, a], right[y][:, b])
                total += np.bincount(place, products, len(total))
        at_row = [self._rows + k // count * views for k in used]
        at_column = [self._columns + k % count * views for k in used]
        rows, columns = np.concatenate(at_row), np.concatenate(at_column)
        totals = totals.ravel()
        # The other order of each pair.
        return Entries(
            np.concatenate([rows, columns]),
            np.concatenate([columns, rows]),
            np.concatenate([totals, totals]),
        )
