"""The linear system of a round: solved densely, or where views are thousands, iteratively."""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
from jaxtyping import Float

# Of the balanced matrix, whose diagonal is 1.
DAMPING = 1e-8
# Up to so many unknowns the matrix is factorised as a whole.
DENSE = 1500
# Groups of neighbouring unknowns, whose common changes a coarse system solves.
GROUPS = 400
# Relative residual at which the iteration ends; a round's step need not be exact.
PRECISION, MOST_ITERATIONS = 1e-7, 2000


class Balanced:
    """A symmetric matrix over its free directions, its diagonal scaled to 1, ready to be solved.

    Args:
        normal: over all parameters.
        basis: columns are the free directions.
    """

    def __init__(self, normal: sp.csr_array, basis: sp.csr_array):
        reduced = sp.csr_array(basis.T @ normal @ basis)
        diagonal = reduced.diagonal()
        free = np.flatnonzero(diagonal > 1e-30)
        self._scale = 1 / np.sqrt(diagonal[free])
        self._directions = basis[:, free]
        scaling = sp.diags_array(self._scale)
        matrix = scaling @ reduced[free][:, free] @ scaling
        self._matrix = sp.csr_array(matrix + DAMPING * sp.eye_array(len(free)))
        self._solve = _dense(self._matrix) if len(free) <= DENSE else _iterative(self._matrix)

    def solve(self, right: Float[np.ndarray, "d ..."]) -> Float[np.ndarray, "d ..."]:
        """Return the solution along the free directions."""
        scale = self._scale.reshape(-1, *[1] * (right.ndim - 1))
        return self._directions @ (scale * self._solve(scale * (self._directions.T @ right)))


def _dense(matrix: sp.csr_array):
    whole = matrix.toarray()
    return lambda right: np.linalg.solve(whole, right)


def _iterative(matrix: sp.csr_array):
    """Conjugate gradients with a two-level preconditioner.

    A long drive is a chain: what is wrong by a little everywhere adds up from its one end to its
    other, and takes as many iterations as there are links. Sums over groups of neighbours are
    therefore solved exactly.
    """
    count = matrix.shape[0]
    group = np.arange(count) * GROUPS // count
    coarse = sp.csr_array((np.ones(count), (np.arange(count), group)))
    factor = scipy.linalg.cho_factor((coarse.T @ matrix @ coarse).toarray())

    def precondition(residual):
        return residual + coarse @ scipy.linalg.cho_solve(factor, coarse.T @ residual)

    preconditioner = scipy.sparse.linalg.LinearOperator((count, count), precondition)

    def one(right):
        found, _ = scipy.sparse.linalg.cg(
            matrix, right, rtol=PRECISION, maxiter=MOST_ITERATIONS, M=preconditioner
        )
        return found

    def solve(right):
        if right.ndim == 1:
            return one(right)
        return np.stack([one(column) for column in right.T], 1)

    return solve
