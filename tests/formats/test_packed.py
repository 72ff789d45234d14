"""Packed Gaussians: errors stay within half a step of each column, shapes are what they were."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax.formats.packed import CHUNK, column_bits, morton_order, pack, unpack
from p2gs_jax.types import Gaussians


def cloud(count, coefficients=4, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=jnp.asarray(rng.normal(size=(count, 3)) * (10, 1, 300), jnp.float32),
        quats=jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        log_scales=jnp.asarray(rng.uniform(-6, 1, (count, 3)), jnp.float32),
        opacity_logits=jnp.asarray(rng.normal(size=count) * 3, jnp.float32),
        sh=jnp.asarray(rng.normal(size=(count, coefficients, 3)), jnp.float32),
    )


def covariances(g):
    axes = Rotation.from_quat(np.asarray(g.quats, float), scalar_first=True).as_matrix()
    return np.einsum("nij,nj,nkj->nik", axes, np.exp(2 * np.asarray(g.log_scales, float)), axes)


@pytest.mark.parametrize("count", [1, CHUNK, 3 * CHUNK + 17])
def test_every_number_comes_back_within_half_a_step_of_its_chunk(count):
    g = cloud(count)
    packed, order = pack(g), morton_order(np.asarray(g.means))
    back, bits = unpack(packed), column_bits(4)
    for name, first in (("means", 0), ("log_scales", 3), ("opacity_logits", 9), ("sh", 10)):
        given = np.asarray(getattr(g, name))[order].reshape(count, -1)
        read = np.asarray(getattr(back, name)).reshape(count, -1)
        for column in range(given.shape[1]):
            for start in range(0, count, CHUNK):
                part = slice(start, start + CHUNK)
                values = given[part, column].astype(float)
                step = np.ptp(values) / (2 ** bits[first + column] - 1)
                error = np.abs(read[part, column] - values).max()
                assert error <= 0.501 * step + 1e-6 * np.abs(values).max(), (name, column)


def test_rotations_change_but_ellipsoids_do_not():
    g = cloud(1000)
    order = morton_order(np.asarray(g.means))
    given, read = covariances(g)[order], covariances(unpack(pack(g)))
    size = np.trace(given, axis1=1, axis2=2)
    assert (np.abs(read - given).max((1, 2)) / size).max() < 0.02


def test_a_rotation_of_length_zero_is_none_at_all_and_nothing_can_be_packed():
    g = cloud(3)
    g = replace(g, quats=jnp.zeros((3, 4)))
    np.testing.assert_allclose(np.asarray(unpack(pack(g)).quats), [[1, 0, 0, 0]] * 3, atol=1e-3)
    assert unpack(pack(cloud(0))).capacity == 0


def test_neighbours_in_the_order_are_neighbours_in_space():
    means = np.asarray(cloud(2000).means) / (10, 1, 300)
    steps = np.linalg.norm(np.diff(means[morton_order(means)], axis=0), axis=1)
    assert np.median(steps) < 0.25 * np.median(np.linalg.norm(np.diff(means, axis=0), axis=1))
