"""Projection and harmonics against definitions: the rasterizer's oracle shares their code."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import street
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import project
from p2gs_jax.render.harmonics import MAX_DEGREE, basis
from p2gs_jax.scene.rigid import pose_of

CFG = RenderConfig()


def rotation(quat):
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()


def by_definition(g, cam, i):
    """Return centre, covariance and depth of a splat: J W S W^T J^T + blur (EWA; 3DGS, eq. 5)."""
    R, t = cam.viewmat[:3, :3], cam.viewmat[:3, 3]
    x, y, z = R @ g.means[i] + t
    fx, fy, cx, cy = cam.K[0, 0], cam.K[1, 1], cam.K[0, 2], cam.K[1, 2]
    J = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    M = rotation(g.quats[i]) * np.exp(g.log_scales[i])
    covariance = J @ R @ M @ M.T @ R.T @ J.T + CFG.blur * np.eye(2)
    return np.array([fx * x / z + cx, fy * y / z + cy]), covariance, z


def test_splats_follow_the_definition():
    with jax.enable_x64(True):
        g, cam = street(dtype=np.float64)
        viewmat = pose_of(rotation(np.array([1, 0.05, -0.1, 0.2])), (0.3, -0.2, 0.5))
        cam = dataclasses.replace(cam, viewmat=jnp.asarray(viewmat))
        splats = jax.jit(lambda g: project(g, jnp.ones(g.capacity, bool), cam, CFG))(g)
        splats, g, cam = jax.tree.map(np.asarray, (splats, g, cam))
    inside = (splats.means2d > 0).all(1) & (splats.means2d < [cam.width, cam.height]).all(1)
    rows = np.flatnonzero(splats.visible & inside)
    assert len(rows) > 30
    for i in rows[:200]:
        center, covariance, z = by_definition(g, cam, i)
        np.testing.assert_allclose(splats.means2d[i], center, rtol=1e-9)
        np.testing.assert_allclose(splats.cov_diagonal[i], np.diag(covariance), rtol=1e-9)
        a11, a12, a22 = splats.conic_factor[i]
        factor = np.array([[a11, a12], [0, a22]])
        np.testing.assert_allclose(factor.T @ factor @ covariance, np.eye(2), atol=1e-7)
        assert splats.depths[i] == pytest.approx(z)
        opacity = 1 / (1 + np.exp(-g.opacity_logits[i]))
        assert np.exp(splats.log_opacities[i]) == pytest.approx(opacity)


def test_harmonics_agree_with_scipy_in_the_signs_of_3dgs():
    d = np.random.default_rng(0).normal(size=(50, 3))
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
