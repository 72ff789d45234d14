"""Sums of entries of matrices: dense while small, sparse where views are many."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

# Up to so many unknowns matrices are kept and factorised as a whole.
DENSE = 1500

Matrix = np.ndarray | sp.csr_array


def is_small(size: int) -> bool:
    """Return whether matrices of so many unknowns are kept as a whole."""
    return size <= DENSE


class Entries(NamedTuple):
    """Values at places of a matrix; those at one place are summed.

    Attributes:
        rows: where.
        columns: where.
        values: what.
    """

    rows: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


def block(row: int, column: int, values: Float[np.ndarray, "n m"]) -> Entries:
    """Return a dense block at a place."""
    at = np.indices(values.shape)
    return Entries((row + at[0]).ravel(), (column + at[1]).ravel(), values.ravel())


def assembled(parts: list[Entries], size: int) -> Matrix:
    """Return the square matrix of all entries.

    Args:
        parts: its entries.
        size: of the matrix.
    """
    rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not is_small(size):
        return sp.csr_array((values, (rows, columns)), shape=(size, size))
    return np.bincount(rows * size + columns, values, size**2).reshape(size, size)


@dataclass(frozen=True)
class Terms:
    """What every value depends on linearly, in a fixed number of terms.

    Attributes:
        index: parameter of each term; `count` where a term is none.
        factor: of that parameter.
        count: number of parameters.
    """

    index: Int[np.ndarray, "o 3 m"]
    factor: Float[np.ndarray, "o 3 m"]
    count: int

    def of(self, parameters: Float[np.ndarray, " k"]) -> Float[np.ndarray, "o 3"]:
        """Return the sums at some parameters."""
        return (np.append(parameters, 0.0)[self.index] * self.factor).sum(-1)

    def joined(self, other: Terms) -> Terms:
        """Return the terms of two sets of parameters, these first."""
        count = self.count + other.count
        mine = np.where(self.index == self.count, count, self.index)
        return Terms(
            np.concatenate([mine, other.index + self.count], -1),
            np.concatenate([self.factor, other.factor], -1),
            count,
        )

    def sums(
        self, values: Float[np.ndarray, "o 3"], place: Int[np.ndarray, "o 3"], places: int
    ) -> Float[np.ndarray, "places k"]:
        """Return sums of values times factors at places, for each parameter.

        Args:
            values: what is summed.
            place: where each belongs.
            places: their number.
        """
        width = self.count + 1
        at = place[..., None] * width + self.index
        total = np.bincount(at.ravel(), (values[..., None] * self.factor).ravel(), places * width)
        return total.reshape(places, width)[:, :-1]

    def products(self, values: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "k k"]:
        """Return the sum of values times the outer products of factors."""
        width, terms = self.count + 1, range(self.index.shape[-1])
        own, mixed = np.zeros(width**2), np.zeros(width**2)
        for x in terms:
            left = values * self.factor[..., x]
            for y in range(x + 1):
                at = self.index[..., x] * width + self.index[..., y]
                found = np.bincount(at.ravel(), (left * self.factor[..., y]).ravel(), width**2)
                total = own if x == y else mixed
                total += found
        half = mixed.reshape(width, width)
        return (own.reshape(width, width) + half + half.T)[:-1, :-1]
