"""Sums of entries of matrices: dense while small, sparse where views are many."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

DENSE = 1500  # up to this many unknowns, matrices are kept and factorised as a whole
CHUNK = 1 << 15  # pairs whose products are formed at once: they stay in the cache

Matrix = np.ndarray | sp.csr_array | sp.csc_array


def is_small(size: int) -> bool:
    """Return whether matrices of this many unknowns are kept as a whole."""
    return size <= DENSE


class Entries(NamedTuple):
    """Values at places of a matrix; those at one place are summed."""

    rows: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


def block(row: int, column: int, values: Float[np.ndarray, "n m"]) -> Entries:
    """Return a dense block whose first entry is at a place."""
    at = np.indices(values.shape)
    return Entries((row + at[0]).ravel(), (column + at[1]).ravel(), values.ravel())


def assembled(parts: list[Entries], size: int) -> Matrix:
    """Return the square matrix of all entries."""
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not is_small(size):
        return sp.csr_array((values, (rows, columns)), shape=(size, size))
    return np.bincount(rows * size + columns, values, size**2).reshape(size, size)


def whole(matrix: Matrix) -> Float[np.ndarray, "n n"]:
    """Return a matrix that is dense."""
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


class Alike(NamedTuple):
    """Values that depend on the same parameters: their products are small and dense."""

    where: Int[np.ndarray, " n"]  # among all values, channels of an observation in turn
    columns: Int[np.ndarray, " m"]  # parameter of each term; `Terms.count` where there is no term
    factors: Float[np.ndarray, "m n"]  # of that parameter


@dataclass(frozen=True)
class Terms:
    """What every value depends on linearly, in a fixed number of terms.

    Few of all combinations of parameters occur; `groups` holds each with its values.
    """

    groups: tuple[Alike, ...]
    count: int  # number of parameters
    values: int  # number of values

    @classmethod
    def of_index(
        cls, index: Int[np.ndarray, "o 3 m"], factor: Float[np.ndarray, "o 3 m"], count: int
    ) -> Terms:
        """Lay out terms by their parameters, `count` where there is none, and by their factors."""
        index, factor = (part.reshape(-1, part.shape[-1]) for part in (index, factor))
        short = index.astype(np.min_scalar_type(count))  # sorted faster
        order = np.lexsort(short.T)
        differs = (short[order[1:]] != short[order[:-1]]).any(1)
        groups = np.split(order, np.flatnonzero(differs) + 1)
        alike = (Alike(g, index[g[0]], factor[g].T.copy()) for g in groups if len(g))
        return cls(tuple(alike), count, len(index))

    def of(self, parameters: Float[np.ndarray, " k"]) -> Float[np.ndarray, "o 3"]:
        """Return the sums at some parameters."""
        parameters, out = np.append(parameters, 0.0), np.zeros(self.values)
        for where, columns, factors in self.groups:
            out[where] = parameters[columns] @ factors
        return out.reshape(-1, 3)

    def scaled(self, by: Float[np.ndarray, "o 1"], terms: int) -> Terms:
        """Return these with the first of all terms multiplied by a number an observation."""
        by, groups = np.repeat(by, 3), []
        for where, columns, factors in self.groups:
            scaled = np.concatenate([by[where] * factors[:terms], factors[terms:]])
            groups.append(Alike(where, columns, scaled))
        return replace(self, groups=tuple(groups))

    def sums(
        self, values: Float[np.ndarray, "o 3"], place: Int[np.ndarray, "o 3"], places: int
    ) -> Float[np.ndarray, "places k"]:
        """Return sums of values times factors at each of `places` places, for each parameter."""
        total, values, place = np.zeros((self.count + 1, places)), values.ravel(), place.ravel()
        for where, columns, factors in self.groups:
            here, weights = place[where], values[where]
            for column, factor in zip(columns, factors, strict=True):
                # `bincount` would go through all places for each of many groups.
                np.add.at(total[column], here, weights * factor)
        return total[:-1].T

    def total(self, values: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, " k"]:
        """Return the sum of values times factors for each parameter."""
        total, values = np.zeros(self.count + 1), values.ravel()
        for where, columns, factors in self.groups:
            np.add.at(total, columns, factors @ values[where])
        return total[:-1]

    def products(self, values: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "k k"]:
        """Return the sum of values times the outer products of factors."""
        total, values = np.zeros((self.count + 1,) * 2), values.ravel()
        for where, columns, factors in self.groups:
            # No term may stand more than once.
            np.add.at(total, np.ix_(columns, columns), (factors * values[where]) @ factors.T)
        return total[:-1, :-1]


class Pairs:
    """Every pair of observations of a row once, each with itself: few of all pairs of views."""

    def __init__(self, row: Int[np.ndarray, " o"], views: Int[np.ndarray, " o"], view_count: int):
        # Sorted by row, the two of a pair lie close together.
        self._order = np.argsort(row, kind="stable")
        self._views = view_count
        here, seen_by = row[self._order], views[self._order]
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

    def sums(
        self,
        factors: list[Float[np.ndarray, "o 3"]],
        channels: list[list[int]],
        kind: type[np.floating] = np.float64,
    ) -> Entries:
        """Return the sum over rows of outer products of per-view vectors: (x V, x V).

        `factors` are what each of x parameters contributes in the `channels` that it acts in.
        Products are of a `kind`. In the rounds float32: there the matrix decides how fast they
        converge, never where they end. Standard errors need float64: what joins groups of views by
        a few dark points is less than the rounding of what joins the views of a group.
        """
        count, views, own = len(factors), self._views, channels
        parts = [f[:, c][self._order].astype(kind) for f, c in zip(factors, own, strict=True)]
        shared = [[c for c in one if c in other] for one in own for other in own]
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
                a, b = ([own[z].index(c) for c in shared[k]] for z in (x, y))
                products = np.einsum("pf,pf->p", left[x][:, a], right[y][:, b])
                total += np.bincount(place, products, len(total))
        rows = np.concatenate([self._rows + k // count * views for k in used])
        columns = np.concatenate([self._columns + k % count * views for k in used])
        totals = totals.ravel()
        # The other order of each pair.
        both = ((rows, columns), (columns, rows), (totals, totals))
        return Entries(*map(np.concatenate, both))
