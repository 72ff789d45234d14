"""Sums of entries of matrices: dense while small, sparse where views are many."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

DENSE = 1500  # largest number of unknowns for dense matrices
CHUNK = 1 << 15  # number of pairs whose products are formed at once, within the cache

Matrix = np.ndarray | sp.csr_array | sp.csc_array


def is_small(size: int) -> bool:
    """Return whether matrices of this many unknowns are dense."""
    return size <= DENSE


class Entries(NamedTuple):
    """Entries of a matrix; values at the same row and column are summed."""

    rows: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


def block(row: int, column: int, values: Float[np.ndarray, "n m"]) -> Entries:
    """Return a dense block whose first entry is at a row and a column."""
    at = np.indices(values.shape)
    return Entries((row + at[0]).ravel(), (column + at[1]).ravel(), values.ravel())


def assembled(parts: list[Entries], size: int) -> Matrix:
    """Return the square matrix of all entries."""
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not is_small(size):
        return sp.csr_array((values, (rows, columns)), shape=(size, size))
    return np.bincount(rows * size + columns, values, size**2).reshape(size, size)


def whole(matrix: Matrix) -> Float[np.ndarray, "n n"]:
    """Return the matrix as a dense array."""
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


class Alike(NamedTuple):
    """Values that depend on the same parameters: their products are small and dense."""

    where: Int[np.ndarray, " n"]  # index among all values; channels of an observation in turn
    columns: Int[np.ndarray, " m"]  # parameter of each term; `Index.count` where there is no term
    factors: Float[np.ndarray, "m n"]  # factor of that parameter


@dataclass(frozen=True)
class Index:
    """Places of all terms, in the order of the groups; they are made when first needed."""

    groups: tuple[Alike, ...]
    count: int  # number of parameters
    # Place of every value among the channels of all rows, and of all views.
    row_channel: Int[np.ndarray, "o 3"]
    view_channel: Int[np.ndarray, "o 3"]

    def at(self, place: Int[np.ndarray, "o 3"]) -> Int[np.ndarray, " t"]:
        """Return where `Terms.sums` adds every term if the values are at these places."""
        return place.ravel()[self.where] * (self.count + 1) + self.columns

    @functools.cached_property
    def by_row(self) -> Int[np.ndarray, " t"]:
        """Where `Terms.sums` adds every term by row and channel."""
        return self.at(self.row_channel)

    @functools.cached_property
    def by_view(self) -> Int[np.ndarray, " t"]:
        """Where `Terms.sums` adds every term by view and channel."""
        return self.at(self.view_channel)

    @functools.cached_property
    def where(self) -> Int[np.ndarray, " t"]:
        """Value of every term."""
        return _joined([np.tile(g.where, len(g.columns)) for g in self.groups], int)

    @functools.cached_property
    def columns(self) -> Int[np.ndarray, " t"]:
        """Parameter of every term."""
        return _joined([np.repeat(g.columns, len(g.where)) for g in self.groups], int)

    @functools.cached_property
    def squares(self) -> Int[np.ndarray, " s"]:
        """Place of every product of two terms in the flat matrix of their parameters."""
        width = self.count + 1
        return _joined([np.add.outer(width * g.columns, g.columns) for g in self.groups], int)


def _joined(parts: list[np.ndarray], kind: type) -> np.ndarray:
    return np.concatenate([np.zeros(0, kind), *(part.ravel() for part in parts)])


@dataclass(frozen=True)
class Terms:
    """Linear dependence of every value on parameters, in a fixed number of terms.

    Few of all combinations of parameters occur; `groups` holds each of them with its values.
    """

    groups: tuple[Alike, ...]
    values: int  # number of values
    index: Index

    @classmethod
    def of_index(
        cls,
        index: Int[np.ndarray, "o 3 m"],
        factor: Float[np.ndarray, "o 3 m"],
        count: int,
        row_channel: Int[np.ndarray, "o 3"],
        view_channel: Int[np.ndarray, "o 3"],
    ) -> Terms:
        """Group values by the parameters of their terms; the index `count` stands for no term."""
        index, factor = (part.reshape(-1, part.shape[-1]) for part in (index, factor))
        short = index.astype(np.min_scalar_type(count))  # sorted faster
        order = np.lexsort(short.T)
        differs = (short[order[1:]] != short[order[:-1]]).any(1)
        groups = np.split(order, np.flatnonzero(differs) + 1)
        alike = tuple(Alike(g, index[g[0]], factor[g].T.copy()) for g in groups if len(g))
        return cls(alike, len(index), Index(alike, count, row_channel, view_channel))

    def of(self, parameters: Float[np.ndarray, " k"]) -> Float[np.ndarray, "o 3"]:
        """Return the sums at some parameters."""
        parameters, out = np.append(parameters, 0.0), np.zeros(self.values)
        for where, columns, factors in self.groups:
            out[where] = parameters[columns] @ factors
        return out.reshape(-1, 3)

    def scaled(self, by: Float[np.ndarray, "o 1"], terms: int) -> Terms:
        """Return terms whose first `terms` are multiplied by a number per observation."""
        by, groups = np.repeat(by, 3), []
        for where, columns, factors in self.groups:
            scaled = np.concatenate([by[where] * factors[:terms], factors[terms:]])
            groups.append(Alike(where, columns, scaled))
        return replace(self, groups=tuple(groups))

    def sums(
        self, values: Float[np.ndarray, "o 3"], at: Int[np.ndarray, " t"], places: int
    ) -> Float[np.ndarray, "places k"]:
        """Return sums of values times factors at every one of `places`, for each parameter."""
        factors = _joined([group.factors for group in self.groups], float)
        factors *= values.ravel()[self.index.where]
        width = self.index.count + 1
        return np.bincount(at, factors, places * width).reshape(places, width)[:, :-1]

    def total(self, values: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, " k"]:
        """Return the sum of values times factors for each parameter."""
        total, values = np.zeros(self.index.count + 1), values.ravel()
        for where, columns, factors in self.groups:
            np.add.at(total, columns, factors @ values[where])
        return total[:-1]

    def products(self, values: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "k k"]:
        """Return the sum of values times the outer products of factors."""
        width, values = self.index.count + 1, values.ravel()
        each = [(f * values[where]) @ f.T for where, _, f in self.groups]
        total = np.bincount(self.index.squares, _joined(each, float), width**2)
        return total.reshape(width, width)[:-1, :-1]


class Pairs:
    """Every pair of observations in a row once, including an observation with itself."""

    def __init__(self, row: Int[np.ndarray, " o"], views: Int[np.ndarray, " o"], view_count: int):
        # Sorted by row, the observations of a pair are close in memory.
        self._order = np.argsort(row, kind="stable")
        self._view_count = view_count
        here, seen_by = row[self._order], views[self._order]
        at = np.arange(len(here))
        # Each observation is paired with itself and with later ones of the same row.
        following = np.searchsorted(here, here, side="right") - at
        self._first = np.repeat(at, following).astype(np.int32)
        starts = np.cumsum(following) - following
        offset = np.arange(len(self._first)) - np.repeat(starts, following)
        self._second = (self._first + offset).astype(np.int32)
        del offset
        keys = seen_by[self._first] * np.int64(view_count) + seen_by[self._second]
        unique, place = np.unique(keys, return_inverse=True)
        self._place = place.astype(np.int32)
        self._rows, self._columns = unique // max(view_count, 1), unique % max(view_count, 1)

    def sums(
        self,
        factors: list[Float[np.ndarray, "o 3"]],
        channels: list[list[int]],
        kind: type[np.floating] = np.float64,
    ) -> Entries:
        """Return the sum over rows of outer products of per-view vectors: (x V, x V).

        x parameters of each of V views have `factors`, and `channels` in which they act. `kind` is
        the type of products. Rounds use float32: their matrix affects how fast they converge, not
        the result. Standard errors need float64: the coupling of groups of views by a few dark
        points is less than the rounding of the coupling inside a group.
        """
        count, views = len(factors), self._view_count
        parts = [f[:, c][self._order].astype(kind) for f, c in zip(factors, channels, strict=True)]
        shared = [[c for c in one if c in other] for one in channels for other in channels]
        used = [k for k, common in enumerate(shared) if common]
        totals = np.zeros((len(used), len(self._rows)))
        # A chunk has at least half as many pairs as there are entries to add to.
        chunk = max(CHUNK, len(self._rows) // 2)
        for start in range(0, len(self._first), chunk):
            part = slice(start, start + chunk)
            first, second, place = self._first[part], self._second[part], self._place[part]
            # The product of an observation with itself is counted twice below.
            half = np.where(first == second, kind(0.5), kind(1.0))
            left = [np.take(p, first, 0) * half[:, None] for p in parts]
            right = [np.take(p, second, 0) for p in parts]
            for total, k in zip(totals, used, strict=True):
                x, y = divmod(k, count)
                a, b = ([channels[z].index(c) for c in shared[k]] for z in (x, y))
                products = np.einsum("pf,pf->p", left[x][:, a], right[y][:, b])
                total += np.bincount(place, products, len(total))
        rows = np.concatenate([self._rows + k // count * views for k in used])
        columns = np.concatenate([self._columns + k % count * views for k in used])
        totals = totals.ravel()
        # Add each pair in the other order as well.
        both = ((rows, columns), (columns, rows), (totals, totals))
        return Entries(*map(np.concatenate, both))
