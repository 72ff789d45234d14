"""Rates of learned corrections: what a view has of its own moves less the more views there are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import p2gs_jax
from p2gs_jax.photometry.appearance import identity
from p2gs_jax.sweep.fields import with_fields
from p2gs_jax.train.optimizer import appearance_rate, learning_rates, make_optimizer
from p2gs_jax.types import Gaussians, Params, Photometry

GAUSSIANS = Gaussians(
    jnp.zeros((4, 3)), jnp.ones((4, 4)), jnp.zeros((4, 3)), jnp.zeros(4), jnp.zeros((4, 1, 3))
)
HALFWAY = jnp.float32(0.5)


def rates(preset, views, **optimizer):
    """Return the rates of corrections halfway, over their rate by the schedule alone."""
    changes = {f"optimizer.{name}": value for name, value in optimizer.items()}
    cfg = with_fields(p2gs_jax.preset(preset), changes)
    assert cfg.photometry.appearance is not None
    corrections = identity(cfg.photometry.appearance, ["a", "b"] * (views // 2))
    zeros = jnp.zeros(views)
    like = Params(GAUSSIANS, Photometry(zeros, zeros, "log"), corrections)
    found = learning_rates(HALFWAY, jnp.float32(1), 1.0, like, cfg, 1).appearance
    alone = float(appearance_rate(HALFWAY, cfg))
    return jax.tree.map(lambda rate: float(rate) / alone, found)


def test_of_many_views_rates_take_the_root_of_the_ratio():
    assert rates("3dgs_affine", 100) == pytest.approx(0.5)
    assert rates("3dgs_affine", 10) == pytest.approx(1.0)
    assert rates("3dgs_curve", 100) == pytest.approx(1.0)
    assert rates("3dgs_curve", 100, appearance_views=25.0) == pytest.approx(0.5)


def test_what_cameras_share_keeps_its_rate():
    found = rates("ppisp", 100)
    assert (found.exposures, found.colors) == pytest.approx((0.5, 0.5))
    assert (found.responses, found.vignettings) == pytest.approx((1.0, 1.0))


def test_what_all_views_learn_together_keeps_its_rate():
    assert jax.tree.leaves(rates("luminance_gs", 100, appearance_views=25.0)) == pytest.approx(
        [1.0] * 7
    )


@pytest.mark.parametrize("views", [25, 400])
def test_a_visit_moves_a_view_as_far_whatever_their_number(views):
    cfg = p2gs_jax.preset("3dgs_affine")
    optimizer, gradient = make_optimizer(cfg).rest, np.zeros(views, np.float32)
    moments, own = optimizer.init(jnp.zeros(views)), np.zeros(views)
    share = rates("3dgs_affine", views)

    @jax.jit
    def step(moments, row):
        seen = jnp.asarray(gradient).at[row].set(1.0)
        return optimizer.update(seen, moments, rates=jnp.float32(share))

    for row in np.tile(np.arange(views), 2000 // views):
        moved, moments = step(moments, row)
        own += np.asarray(moved)
    # Adam's own bias correction makes first visits of many views smaller.
    per_visit = -own.mean() / (2000 // views)
    assert per_visit == pytest.approx(5.0, rel=0.35)
