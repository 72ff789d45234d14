"""Accuracy without the worst percent."""

import jax
import numpy as np

from p2gs_jax.bench.hard_cases import splats
from p2gs_jax.bench.metrics import trimmed_errors
from p2gs_jax.bench.oracle import Truth


def test_a_contribution_on_the_cutoff_does_not_hide_the_others():
    gradient = jax.tree.map(lambda a: np.ones(a.shape), splats(300))
    exact = Truth(np.full((20, 20, 3), 0.5), gradient)
    linear = exact.linear * (1 + 1e-6)
    off = jax.tree.map(lambda a: a * (1 + 1e-6), gradient)
    linear[3, 4] += 0.1
    off.means[7] += 1.0
    found = trimmed_errors(linear, off, exact)
    np.testing.assert_allclose(found["relative_99"], 1e-6, rtol=1e-3)
    np.testing.assert_allclose(found["gradient_99"], 1e-6, rtol=0.02)
    linear += 1e-3
    assert trimmed_errors(linear, off, exact)["relative_99"] > 1e-3
