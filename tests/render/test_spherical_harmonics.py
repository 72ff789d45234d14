"""The basis against scipy's complex harmonics, in the signs of 3DGS."""

import numpy as np
from scipy.special import sph_harm_y

from p2gs_jax.render.harmonics import MAX_DEGREE, basis


def test_the_basis_is_that_of_3dgs():
    rng = np.random.default_rng(0)
    d = rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    found = basis(tuple(d.astype(np.float32).T), MAX_DEGREE)
    expected = []
    for degree in range(MAX_DEGREE + 1):
        for order in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(order), polar, azimuth)
            expected.append(
                y.real if order == 0 else np.sqrt(2) * (y.imag if order < 0 else y.real)
            )
    np.testing.assert_allclose(np.stack(found), np.stack(expected), atol=2e-6)
