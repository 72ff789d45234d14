"""A step where things move: the gradient of the total loss, by Gaussians and by poses."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax.config import FitConfig
from p2gs_jax.losses.regularizers import pose_terms
from p2gs_jax.losses.total import Partner, total_loss
from p2gs_jax.render.capacity import Room
from p2gs_jax.render.project import HIDDEN
from p2gs_jax.render.visible import BLOCK
from p2gs_jax.train.advance import Controls, finite_names
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import FAULT_NONE, FAULT_NONFINITE, grow_state, initial_state
from p2gs_jax.train.step import Step
from p2gs_jax.types import Batch, Camera, Gaussians, Params, Photometry, Placement

COUNT = BLOCK + 500
WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
OBJECTS, KEYS, KEY, SHARE = 3, 4, 1, 0.3
CONTROLS = Controls(jnp.float32(0.3), jnp.int32(1), jnp.float32(1), jnp.uint32(0))
EXTENT = 2.0


def config() -> FitConfig:
    base = FitConfig()
    return dataclasses.replace(
        base,
        # Smooth: what is cut off makes differences jump.
        render=dataclasses.replace(
            base.render, sh_degree=1, pixels_in_flight=2048, alpha_cutoff=1e-5, stop_error=None
        ),
        densify=dataclasses.replace(base.densify, method=None),
        loss=dataclasses.replace(
            base.loss, regularizers=dataclasses.replace(base.loss.regularizers, object_poses=1e-4)
        ),
    )


def box_poses() -> np.ndarray:
    out = np.tile(np.eye(4), (OBJECTS, 1, 1))
    out[:, :3, :3] = Rotation.random(OBJECTS, rng=np.random.default_rng(2)).as_matrix()
    out[:, :3, 3] = [[-0.8, 0.2, 4.0], [0.9, -0.1, 5.0], [0.0, 0.0, 4.0]]
    return out


def start() -> tuple[Params, np.ndarray]:
    rng = np.random.default_rng(0)
    owner = rng.integers(-1, OBJECTS, COUNT).astype(np.int32)
    z = rng.uniform(3, 8, COUNT)
    xy = rng.uniform(-0.5, 0.5, (COUNT, 2)) * z[:, None] * [WIDTH / FOCAL, HEIGHT / FOCAL]
    means = np.where(
        (owner < 0)[:, None],
        np.concatenate([xy, z[:, None]], 1),
        rng.uniform(-0.6, 0.6, (COUNT, 3)),
    )
    values = (
        means,
        rng.normal(size=(COUNT, 4)),
        rng.normal(-3, 0.4, (COUNT, 3)),
        rng.normal(0, 1, COUNT),
        rng.normal(0, 0.3, (COUNT, 4, 3)) - [[[1.0], *[[0.0]] * 3]],
    )
    gaussians = Gaussians(*(jnp.asarray(a, jnp.float32) for a in values))
    photometry = Photometry(jnp.array([0.1, -0.1]), jnp.array([0.02, 0.0]))
    poses = rng.normal(0, [0.02] * 3 + [0.03] * 3, (KEYS, OBJECTS, 6))
    return Params(gaussians, photometry, None, jnp.asarray(poses, jnp.float32)), owner


def photograph() -> Batch:
    """Return a view in which the last object is not there."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
    viewmats = box_poses().astype(np.float32)
    viewmats[-1] = HIDDEN
    placement = Placement(jnp.asarray(viewmats), jnp.int32(KEY), jnp.float32(SHARE))
    camera = Camera(jnp.eye(4), jnp.asarray(K), WIDTH, HEIGHT, placement)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    ldr = 0.5 + 0.3 * np.sin(np.stack([0.2 * x, 0.3 * y, 0.2 * x + 0.1 * y], -1))
    return Batch(camera, jnp.asarray(ldr, jnp.float32), jnp.ones((HEIGHT, WIDTH)), jnp.int32(1))


@pytest.fixture(scope="module")
def made():
    """Return a step, and the gradient that it should follow."""
    (params, owner), batch, cfg = start(), photograph(), config()
    alive = jnp.arange(COUNT) % 10 != 0
    partner, optimizer = Partner(jnp.int32(0)), make_optimizer(cfg)

    def objective(params):
        return total_loss(
            params,
            alive,
            batch,
            partner,
            cfg,
            capacity=2**17,
            active_degree=1,
            extent=EXTENT,
            owner=jnp.asarray(owner),
        )[0]

    loss, gradient = jax.jit(jax.value_and_grad(objective))(params)
    step = Step(cfg, optimizer, EXTENT)
    room = Room(2**17, 2 * BLOCK)

    def run(params, slots=0):
        state = initial_state(params, alive, optimizer, slots, jnp.asarray(owner))
        return step(state, batch, partner, CONTROLS, room=room, degree=1)

    return SimpleNamespace(
        params=params,
        owner=owner,
        loss=float(loss),
        gradient=jax.tree.map(np.asarray, gradient),
        run=run,
        after=run(params),
        cfg=cfg,
        state=initial_state(params, alive, optimizer, 0, jnp.asarray(owner)),
    )


def test_a_step_follows_the_gradient_of_the_total_loss(made):
    state, report = made.after
    assert int(state.fault.kind) == FAULT_NONE
    assert float(report.loss) == pytest.approx(made.loss, rel=1e-6)
    o, moments = made.cfg.optimizer, state.opt_state.gaussians[0]
    seen = np.asarray(moments.counts) > 0
    assert set(made.owner[seen]) == {-1, 0, 1}
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        g = getattr(made.gradient.gaussians, name)
        mu = np.asarray(getattr(moments.mu, name)) / (1 - o.b1)
        assert np.linalg.norm(mu[seen] - g[seen]) <= 1e-4 * np.linalg.norm(g), name
        assert np.linalg.norm(g[~seen]) <= 1e-6 * np.linalg.norm(g), name
    poses = np.asarray(state.opt_state.poses[0].mu).reshape(KEYS, OBJECTS, 6) / (1 - o.b1)
    g = made.gradient.poses
    assert np.linalg.norm(g) > 0
    np.testing.assert_allclose(poses, g, atol=1e-3 * np.abs(g).max())
    np.testing.assert_array_equal(state.population.owner, made.owner)


def test_the_gradient_by_poses_is_that_of_finite_differences(made):
    """Of few Gaussians: where one comes before another, a picture jumps."""
    few = np.flatnonzero(made.owner >= 0)[:24]
    gaussians = jax.tree.map(lambda a: a[few], made.params.gaussians)
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales + 1.0)
    params = dataclasses.replace(made.params, gaussians=gaussians)

    @jax.jit
    @jax.value_and_grad
    def loss(poses):
        return total_loss(
            dataclasses.replace(params, poses=poses),
            jnp.ones(len(few), bool),
            photograph(),
            Partner(jnp.int32(0)),
            made.cfg,
            capacity=2**14,
            active_degree=1,
            extent=EXTENT,
            owner=jnp.asarray(made.owner[few]),
        )[0]

    g = np.asarray(loss(params.poses)[1])
    largest = [np.eye(g.size)[k].reshape(g.shape) for k in np.argsort(-np.abs(g), axis=None)[:4]]
    h = 1e-3
    for way in (g / np.linalg.norm(g), *largest):
        above, below = (loss(params.poses + step * way)[0] for step in (h, -h))
        slope = (above - below) / (2 * h)
        assert float(slope) == pytest.approx(float(np.sum(g * way)), rel=0.02)


def test_what_the_view_says_nothing_of_rests(made):
    state, _ = made.after
    before, after = np.asarray(made.params.poses), np.asarray(state.params.poses)
    moved = (before != after).any(-1)
    expected = np.zeros((KEYS, OBJECTS), bool)
    expected[KEY : KEY + 2, : OBJECTS - 1] = True
    np.testing.assert_array_equal(moved, expected)
    counts = np.asarray(state.opt_state.poses[0].counts).reshape(KEYS, OBJECTS)
    np.testing.assert_array_equal(counts, expected)


def test_the_prior_is_on_what_is_there(made):
    objects = photograph().camera.objects
    terms = pose_terms(made.params.poses, objects, made.cfg.loss.regularizers)
    p = np.asarray(made.params.poses)
    small = (1 - SHARE) * p[KEY] + SHARE * p[KEY + 1]
    size = (small[:2] / np.repeat([0.02, 0.1], 3)) ** 2
    assert float(terms["object_poses"]) == pytest.approx(1e-4 * size.sum(), rel=1e-5)
    none = dataclasses.replace(made.cfg.loss.regularizers, object_poses=None)
    assert pose_terms(made.params.poses, objects, none) == {}
    assert pose_terms(None, objects, made.cfg.loss.regularizers) == {}


def test_poses_that_are_no_number_are_named(made):
    broken = made.params.poses.at[KEY, 0, 3].set(jnp.nan)
    state, report = made.run(dataclasses.replace(made.params, poses=broken))
    assert int(state.fault.kind) == FAULT_NONFINITE
    assert "gradient of object poses" in finite_names(report.terms, state.params)
    np.testing.assert_array_equal(state.params.poses[:, 0], broken[:, 0])
    assert int(state.step) == 0


def test_slots_grow_empty_and_nobody_s(made):
    state = grow_state(made.state, COUNT + 40)
    owner = np.asarray(state.population.owner)
    np.testing.assert_array_equal(owner[:COUNT], made.owner)
    np.testing.assert_array_equal(owner[COUNT:], -1)


def test_without_boxes_nothing_is_carried(made):
    """No leaf of the state, and no argument of its programs, knows of objects."""
    params = dataclasses.replace(made.params, poses=None)
    state = initial_state(params, jnp.ones(COUNT, bool), make_optimizer(made.cfg))
    names = [jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_flatten_with_path(state)[0]]
    assert not [n for n in names if "owner" in n or "poses" in n]
