"""Gaussians of moving boxes are rendered like Gaussians that were moved to the world."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from splats import random_splats

from p2gs_jax import RenderConfig, required_capacity
from p2gs_jax.gaussians.posed import posed
from p2gs_jax.render import visible as visibility
from p2gs_jax.render.project import HIDDEN, camera_of_each
from p2gs_jax.render.visible import BLOCK, compact, splat
from p2gs_jax.scene.rigid import pose_of
from p2gs_jax.train.capacities import count_view
from p2gs_jax.types import Camera, Placement

WIDTH, HEIGHT = 48, 40
CFG = RenderConfig(sh_degree=3, stop_error=None)
COUNT = 60
# Compiled once per shape; eager calls would compile each operation.
splat_listed = jax.jit(visibility.splat_listed, static_argnums=(5, 6, 7))
in_view = jax.jit(visibility.in_view, static_argnums=3)


def pose(seed: int, at=(0.0, 0.0, 4.0)) -> np.ndarray:
    return pose_of(Rotation.random(rng=np.random.default_rng(seed)).as_matrix(), at)


POSES = np.stack([pose(1, (0.4, 0.2, 4.0)), pose(2, (-0.6, -0.3, 5.0)), pose(3)])
THERE = np.array([True, True, False])  # boxes that exist at the time of the view


def scene():
    """Return Gaussians near the origins of world (owner -1) and boxes, and their owners."""
    g = random_splats(COUNT, degree=3)
    owner = np.arange(COUNT) % 4 - 1
    means = np.array(g.means) * 0.5
    means[owner < 0, 2] += 5
    g = dataclasses.replace(
        g, means=jnp.asarray(means, jnp.float32), log_scales=g.log_scales * 0.3 - 2
    )
    return g, owner.astype(np.int32)


def view(objects: bool = True) -> Camera:
    K = jnp.array([[40.0, 0, WIDTH / 2], [0, 42.0, HEIGHT / 2], [0, 0, 1]])
    turn = Rotation.from_euler("xyz", [0.05, -0.1, 0.2]).as_matrix()
    viewmat = pose_of(turn, (0.1, -0.2, 0.3)).astype(np.float32)
    placement = None
    if objects:
        viewmats = (viewmat.astype(np.float64) @ POSES).astype(np.float32)
        viewmats[~THERE] = HIDDEN
        placement = Placement(jnp.asarray(viewmats))
    return Camera(jnp.asarray(viewmat), K, WIDTH, HEIGHT, placement)


@jax.jit
def seen_by(g, alive, camera, owner=None):
    return splat(g, alive, camera, CFG, 3, owner)


def test_a_camera_in_the_frame_of_the_box_agrees_with_moved_gaussians():
    g, owner = scene()
    ours, shown = seen_by(g, jnp.ones(COUNT, bool), view(), jnp.asarray(owner))
    explicit = posed(g, owner, POSES, THERE)
    assert explicit.capacity == (owner < 2).sum()
    theirs = seen_by(explicit, jnp.ones(explicit.capacity, bool), view(objects=False))
    assert np.asarray(ours.visible)[owner < 2].sum() > 20
    for a, b in zip(jax.tree.leaves((ours, shown)), jax.tree.leaves(theirs), strict=True):
        there = np.asarray(ours.visible)[owner < 2]
        a, b = np.asarray(a)[owner < 2][there], np.asarray(b)[there]
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * max(1.0, np.abs(b).max()))
    assert not np.asarray(ours.visible)[owner == 2].any()


@pytest.mark.parametrize("known", [True, False])
def test_absent_objects_are_rendered_as_if_they_were_removed(known):
    """One object is not tracked at the time; without a time all are absent."""
    g, owner = scene()
    gone = owner == 2 if known else owner >= 0
    camera = view(known)
    alive, owner = jnp.ones(COUNT, bool), jnp.asarray(owner)
    ours, removed = (seen_by(g, a, camera, owner)[0] for a in (alive, jnp.asarray(~gone)))
    np.testing.assert_array_equal(ours.visible, removed.visible)
    np.testing.assert_array_equal(ours.log_opacities, removed.log_opacities)
    if not known:
        return

    def total(g):
        splats, _ = seen_by(g, alive, camera, owner)
        return splats.means2d.sum() + splats.conic_factor.sum() + splats.log_opacities.sum()

    for leaf in jax.tree.leaves(jax.jit(jax.grad(total))(g)):
        assert np.isfinite(leaf).all()
        assert not np.asarray(leaf)[gone].any()


def test_bounds_and_capacities_account_for_poses_of_objects():
    (g, owner), alive, camera = scene(), jnp.ones(COUNT, bool), view()
    each = jax.jit(camera_of_each)(camera, jnp.asarray(owner))
    seen = np.asarray(in_view(g, alive, each, CFG))
    shown = np.asarray(seen_by(g, alive, camera, jnp.asarray(owner))[0].visible)
    assert seen.any()
    assert not seen[owner == 2].any()
    entries, visible = count_view(
        *jax.tree.map(np.asarray, (g, alive, camera)), CFG, np.asarray(owner)
    )
    assert visible == seen.sum()
    needed = jax.jit(required_capacity, static_argnums=3)(g, alive, camera, CFG, jnp.asarray(owner))
    assert 0 < needed <= 1.01 * entries + 8
    assert shown.sum() >= seen.sum() > 0


def test_blocks_pose_each_gaussian_by_its_box():
    (g, owner), alive, camera = scene(), jnp.ones(COUNT, bool), view()
    ids, count = jax.jit(compact, static_argnums=1)(alive, BLOCK)
    listed = splat_listed(g, alive, ids, count, camera, CFG, 3, 16, jnp.asarray(owner))
    whole = seen_by(g, alive, camera, jnp.asarray(owner))
    for a, b in zip(jax.tree.leaves(listed), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(np.asarray(a)[:COUNT], b, rtol=1e-5, atol=1e-5)
    assert not np.asarray(listed[0].visible)[COUNT:].any()
