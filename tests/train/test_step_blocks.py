"""A step in blocks is one Adam update of the loss; a failed step changes only the fault."""

import dataclasses
import functools
import re
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from noise_views import DEGREE, EXTENT, HEIGHT, WIDTH, config, start, view

from p2gs_jax.presets import with_values
from p2gs_jax.render import rasterize_pallas, tiles
from p2gs_jax.render.capacity import Capacity
from p2gs_jax.render.visible import BLOCK, in_view, splat
from p2gs_jax.train import step as steps
from p2gs_jax.train.exposure_loss import Partner
from p2gs_jax.train.image_gradient import image_loss
from p2gs_jax.train.optimizer import learning_rates, make_optimizer
from p2gs_jax.train.state import FAULT_NONE, FAULT_NONFINITE, FAULT_OVERFLOW, initial_state
from p2gs_jax.train.step import Step, per_gaussian
from p2gs_jax.train.terms import loss_terms
from p2gs_jax.train.update import Controls, finite_names
from p2gs_jax.types import Batch

COUNT, HIDDEN = 6000, 600
PROGRESS, RATE = 0.3, 0.7
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")
PHOTOMETRY = ("raw_exposures", "raw_gammas")
NEAR_DEPTH = 5.0  # of Gaussians from 3 to 8
CFG = with_values(config(method=None), {"loss.near_depth": NEAR_DEPTH})
CONTROLS = Controls(np.float32(PROGRESS), np.int32(DEGREE), np.float32(RATE), np.uint32(0))


def photograph() -> Batch:
    return view(1)[0]


@pytest.fixture(scope="module")
def made():
    """Return a step that overflows and one that does not, and the expected gradient."""
    # More Gaussians are in view than fit into a block, and some are behind the camera.
    params, batch = jax.tree.map(jnp.asarray, (start(COUNT, 0.45, HIDDEN), photograph()))
    optimizer = make_optimizer(CFG)
    # A tenth of the slots are empty.
    alive = jnp.arange(COUNT) % 10 != 0
    run, partner = Step(CFG, optimizer, EXTENT), Partner(jnp.int32(0))

    def step(capacity, params=params):
        state = initial_state(params, alive, optimizer)
        return run(state, batch, partner, CONTROLS, capacity=capacity, degree=DEGREE)

    def objective(params, probe):
        splats, radiance = splat(params.gaussians, alive, batch.camera, CFG.render, DEGREE)
        splats = dataclasses.replace(splats, means2d=splats.means2d + probe)
        inputs = (batch, partner, CFG, loss_terms(CFG), 2**16)
        return image_loss((splats, radiance), params.photometry, None, *inputs)[0]

    slope = jax.jit(jax.value_and_grad(objective, argnums=(0, 1)))
    loss, (gradient, probe) = jax.device_get(slope(params, jnp.zeros((COUNT, 2))))
    R, t = batch.camera.viewmat[:3, :3], batch.camera.viewmat[:3, 3]
    depths = np.asarray(params.gaussians.means @ R[2] + t[2])
    share = np.clip(depths / NEAR_DEPTH, 0, 1) ** 2
    near = jax.tree.map(lambda g: (g.T * share).T, (gradient.gaussians, probe))
    gradient, probe = dataclasses.replace(gradient, gaussians=near[0]), near[1]
    tight = Capacity(64, BLOCK)
    overflowed = step(tight)
    fault = overflowed[0].fault
    capacity = tight.grown(int(fault.needed), int(fault.visible))
    seen = np.asarray(in_view(params.gaussians, alive, batch.camera, CFG.render))
    expected = {"gradient": gradient, "probe": probe, "loss": float(loss), "seen": seen}
    after = step(capacity)
    calls = {"tight": tight, "overflowed": overflowed, "capacity": capacity, "step": step}
    return SimpleNamespace(params=params, alive=np.asarray(alive), **expected, **calls, after=after)


def rows_of(tree, name, rows):
    return np.asarray(getattr(tree, name))[rows]


def test_one_step_is_an_adam_update_of_the_gradient_of_the_loss(made):
    state, report = made.after
    assert int(state.fault.kind) == FAULT_NONE
    assert int(state.step) == 1
    assert float(report.loss) == pytest.approx(made.loss, rel=1e-6)
    assert int(report.visible) == made.seen.sum()
    rates_at = jax.jit(learning_rates, static_argnums=(2, 4, 5))
    rates = rates_at(PROGRESS, RATE, EXTENT, made.params, CFG, (DEGREE + 1) ** 2)
    o = CFG.optimizer
    adam = optax.scale_by_adam(o.b1, o.b2, o.eps)
    updates, _ = jax.jit(adam.update)(made.gradient, jax.jit(adam.init)(made.params))
    moments = state.opt_state.gaussians
    for name in FIELDS:
        g = rows_of(made.gradient.gaussians, name, made.seen)
        mu = rows_of(moments.mu, name, made.seen) / (1 - o.b1)
        nu = rows_of(moments.nu, name, made.seen) / (1 - o.b2)
        assert np.linalg.norm(mu - g) <= 1e-5 * np.linalg.norm(g), name
        assert np.linalg.norm(np.sqrt(nu) - np.abs(g)) <= 1e-4 * np.linalg.norm(g), name
        rate = np.asarray(getattr(rates.gaussians, name))
        old = rows_of(made.params.gaussians, name, made.seen)
        new = rows_of(state.params.gaussians, name, made.seen)
        expected = old - rate * rows_of(updates.gaussians, name, made.seen)
        np.testing.assert_allclose(new, expected, rtol=1e-6, atol=2e-3 * rate.max())
        assert np.abs(new - old).max() > 0.5 * rate.max(), name
    got, v = state.opt_state.rest.mu[0], made.gradient.photometry
    for name in PHOTOMETRY:
        np.testing.assert_allclose(
            getattr(got, name) / (1 - 0.9), getattr(v, name), rtol=1e-4, atol=1e-8
        )


def widened(tree):
    narrow = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda a: a.astype(np.float64) if a.dtype.kind == "f" else a, narrow)


def test_a_step_agrees_with_one_that_is_float64_throughout(made):
    optimizer = make_optimizer(CFG)
    start = widened(initial_state(made.params, made.alive, optimizer))
    args = widened((photograph(), Partner(np.int32(0)), CONTROLS))
    with jax.enable_x64(True):
        step = Step(CFG, optimizer, EXTENT)
        wide = step(jax.tree.map(jnp.asarray, start), *args, capacity=made.capacity, degree=DEGREE)
    (state, report), (exact, exact_report) = made.after, jax.device_get(wide)
    assert int(exact.fault.kind) == FAULT_NONE
    for path, leaf in jax.tree_util.tree_leaves_with_path(wide):
        assert leaf.dtype.kind != "f" or leaf.dtype == np.float64, jax.tree_util.keystr(path)
    assert float(report.loss) == pytest.approx(float(exact_report.loss), rel=1e-6)
    assert float(report.loss) != float(exact_report.loss)  # the precisions differ
    of_gaussians = [s.opt_state.gaussians.mu for s in (state, exact)]
    of_photometry = [s.opt_state.rest.mu[0] for s in (state, exact)]
    for name in (*FIELDS, *PHOTOMETRY):
        moments = of_photometry if name in PHOTOMETRY else of_gaussians
        got, expected = (getattr(m, name) for m in moments)
        assert np.any(expected), name
        assert np.linalg.norm(got - expected) < 1e-4 * np.linalg.norm(expected), name


def test_gaussians_out_of_view_do_not_change(made):
    state, _ = made.after
    hidden = ~made.seen
    assert hidden.sum() > HIDDEN / 2
    moments = state.opt_state.gaussians
    for name in FIELDS:
        before = rows_of(made.params.gaussians, name, hidden)
        assert rows_of(state.params.gaussians, name, hidden).tobytes() == before.tobytes(), name
        assert not rows_of(moments.mu, name, hidden).any(), name
        assert not rows_of(moments.nu, name, hidden).any(), name
    np.testing.assert_array_equal(moments.counts, made.seen.astype(np.int32))


def test_without_visible_only_all_gaussians_are_listed(made):
    cfg = with_values(CFG, {"optimizer.visible_only": False})
    step, capacity, state = Step(cfg, make_optimizer(cfg), EXTENT), made.capacity, made.after[0]
    listed = step.program("show", capacity, DEGREE)(
        *per_gaussian(state, step.frustum(photograph()), CONTROLS)
    )
    assert int(listed.visible) == COUNT
    np.testing.assert_array_equal(listed.ids, np.minimum(np.arange(len(listed.ids)), COUNT))


def test_the_densification_statistic_is_the_screen_space_gradient(made):
    state, _ = made.after
    norm = np.linalg.norm(made.probe * [WIDTH / 2, HEIGHT / 2], axis=1)
    assert norm.max() > 0
    got = np.asarray(state.population.grad2d_sum)
    assert np.linalg.norm(got - norm) <= 1e-5 * np.linalg.norm(norm)
    np.testing.assert_array_equal(state.population.seen_count, norm > 0)


def test_a_view_that_overflows_changes_nothing_but_the_fault(made):
    state, report = made.overflowed
    fresh = initial_state(made.params, jnp.asarray(made.alive), make_optimizer(CFG))
    chex.assert_trees_all_equal(dataclasses.replace(state, fault=fresh.fault), fresh)
    assert int(state.fault.kind) == FAULT_OVERFLOW
    assert int(state.fault.visible) == made.seen.sum() > made.tight.visible
    assert int(state.fault.needed) > made.tight.entries
    assert int(report.visible) == made.seen.sum()
    grown = made.after[1]
    assert int(grown.entries) <= made.capacity.entries
    assert int(grown.visible) <= made.capacity.visible


@pytest.mark.parametrize(
    ("field", "named"),
    [
        ("sh", "loss term"),
        ("quats", "gradient of"),
        # This exposure belongs to another view: only the mean over all views contains it.
        ("raw_exposures", "loss term log_exposure_mean"),
    ],
)
def test_the_first_part_that_is_not_finite_is_named(made, field, named):
    part = "photometry" if field in PHOTOMETRY else "gaussians"
    before, row = getattr(made.params, part), 0 if field in PHOTOMETRY else np.argmax(made.seen)
    broken = dataclasses.replace(before, **{field: getattr(before, field).at[row].set(jnp.nan)})
    params = dataclasses.replace(made.params, **{part: broken})
    state, report = made.step(made.capacity, params)
    assert int(state.fault.kind) == FAULT_NONFINITE
    assert int(state.step) == 0
    assert finite_names(report.terms, state.params)[int(state.fault.term)].startswith(named)
    if field == "sh":
        fresh = initial_state(params, jnp.asarray(made.alive), make_optimizer(CFG))
        chex.assert_trees_all_equal(dataclasses.replace(state, fault=fresh.fault), fresh)


class ForCuda:
    """A program that is lowered for NVIDIA GPUs."""

    def __init__(self, name, **static):
        self.jitted = jax.jit(functools.partial(steps.PROGRAMS[name], **static))

    def lower(self, *args):
        return self.jitted.trace(*args).lower(lowering_platforms=("cuda",))

    def eval_shape(self, *args):
        return self.jitted.eval_shape(*args)


@pytest.mark.skipif(
    jax.__version_info__ >= (0, 11) and jax.default_backend() != "gpu",
    reason="from JAX 0.11 on Pallas lowers only for a GPU of this machine",
)
@pytest.mark.parametrize("name", list(steps.PROGRAMS))
def test_a_step_on_a_gpu_never_waits_for_the_host(monkeypatch, name):
    """On GPUs, conditionals and loops of unknown length wait until the host has read a flag."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(rasterize_pallas, "_interpreted", lambda: False)
    monkeypatch.setattr(tiles, "fastest_here", lambda: "pallas")
    monkeypatch.setattr(steps, "compiled", ForCuda)
    params, optimizer = start(), make_optimizer(CFG)
    state = initial_state(params, np.ones(params.gaussians.capacity, bool), optimizer)
    step, capacity = Step(CFG, optimizer, EXTENT, noise=1.0), Capacity(4096, BLOCK)
    lowered = step.lowered(name, state, *view(0), CONTROLS, capacity=capacity, degree=DEGREE)
    text = lowered.as_text()
    assert "stablehlo" in text
    for waits in ("stablehlo.case", "stablehlo.if", "callback"):
        assert waits not in text, waits
    for condition in re.findall(r"stablehlo\.while.*?cond \{(.*?)\} do", text, re.DOTALL):
        assert "stablehlo.constant" in condition, "a loop of unknown length"
