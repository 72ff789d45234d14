"""The linear system of a round: solved densely, or where views are thousands, iteratively."""

from __future__ import annotations

import functools

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
import threadpoolctl
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.matrices import Matrix, is_small

# Of the balanced matrix, whose diagonal is 1.
DAMPING = 1e-8
# Groups of neighbouring unknowns, whose common changes a coarse system solves.
GROUPS = 1000
# Relative residual at which the iteration ends; a round's step need not be exact.
PRECISION, MOST_ITERATIONS = 1e-7, 2000


@functools.cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    return threadpoolctl.ThreadpoolController()


def one_thread():
    """Return a context in which BLAS does not wake threads.

    It does so for a system of a hundred unknowns, and waits for busy cores: 52 ms instead of 2
    while something else computes (BUILD_NOTES).
    """
    return _libraries().limit(limits=1, user_api="blas")


class Balanced:
    """A symmetric matrix over its free directions, its diagonal scaled to 1, ready to be solved.

    Args:
        normal: over all parameters.
        gauges: few rows, whose outer products are added to it.
        basis: columns are the free directions.
    """

    def __init__(self, normal: Matrix, gauges: sp.csr_array, basis: sp.csr_array):
        reduced, held = basis.T @ normal @ basis, sp.csr_array(gauges @ basis)
        diagonal = reduced.diagonal() + held.power(2).sum(0)
        free = np.flatnonzero(diagonal > 1e-30)
        self._scale = 1 / np.sqrt(diagonal[free])
        self._directions = basis[:, free]
        scaling = sp.diags_array(self._scale, format="csr")
        matrix = scaling @ reduced[free][:, free] @ scaling
        low_rank = held[:, free] @ scaling
        if is_small(len(free)):
            whole = matrix.toarray() if sp.issparse(matrix) else matrix
            self._solve = _dense(whole + (low_rank.T @ low_rank).toarray())
        else:
            self._solve = _iterative(sp.csr_array(matrix), low_rank.toarray())

    def solve(self, right: Float[np.ndarray, "d ..."]) -> Float[np.ndarray, "d ..."]:
        """Return the solution along the free directions."""
        scale = self._scale.reshape(-1, *[1] * (right.ndim - 1))
        return self._directions @ (scale * self._solve(scale * (self._directions.T @ right)))


def _dense(matrix: Float[np.ndarray, "n n"]):
    matrix[np.diag_indices_from(matrix)] += DAMPING
    return lambda right: np.linalg.solve(matrix, right)


def _iterative(sparse: sp.csr_array, low_rank: Float[np.ndarray, "g n"]):
    """Conjugate gradients with a two-level preconditioner.

    A long drive is a chain: what is wrong by a little everywhere adds up from its one end to its
    other, and takes as many iterations as there are links. Sums over groups of neighbours are
    therefore solved exactly.
    """
    count = low_rank.shape[1]
    sparse = sp.csr_array(sparse + DAMPING * sp.eye_array(count))
    group = np.arange(count) * GROUPS // count
    coarse = sp.csr_array((np.ones(count), (np.arange(count), group)))
    grouped = low_rank @ coarse
    factor = scipy.linalg.cho_factor((coarse.T @ sparse @ coarse).toarray() + grouped.T @ grouped)

    def multiply(x):
        return sparse @ x + low_rank.T @ (low_rank @ x)

    def precondition(residual):
        return residual + coarse @ scipy.linalg.cho_solve(factor, coarse.T @ residual)

    shape = (count, count)
    matrix = scipy.sparse.linalg.LinearOperator(shape, multiply)
    preconditioner = scipy.sparse.linalg.LinearOperator(shape, precondition)

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
