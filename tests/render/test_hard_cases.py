"""Hard cases over every implementation, against the float64 oracle (benchmarks/hard_cases)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import hard_cases
from benchmarks.hard_cases import CASES, VIEW, HardCase, crowd, gap
from p2gs_jax.render import render_linear

BASE = hard_cases.CONFIG
IMPLEMENTATIONS = {
    "xla, counting": dataclasses.replace(BASE, implementation="xla", binning="counting"),
    "pallas, interpreted": dataclasses.replace(BASE, implementation="pallas", binning="sorting"),
}


@functools.cache
def oracle(name: str):
    case = next(c for c in CASES if c.name == name)
    return hard_cases.float64_oracle(case.build(), case.view, BASE)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.name, marks=pytest.mark.slow if c.name.startswith("10^5") else ())
        for c in CASES
    ],
)
def test_hard_case(case: HardCase, implementation: str):
    cfg = IMPLEMENTATIONS[implementation]
    if case.view is not VIEW and implementation != "xla, counting":
        pytest.skip("an image of another size costs a program")
    g = gap(case, cfg, oracle(case.name))
    assert g.finite, case.expect
    assert g.silent == case.unseen, case.expect
    # The stop rule may add its own error, and a flipped pair moves gradients by its cutoff.
    stop = cfg.stop_error
    assert g.value <= case.value_tolerance + stop, g
    assert g.relative <= 1e-3, g
    assert g.gradient <= case.gradient_tolerance + 4 * stop + g.undecided * cfg.alpha_cutoff, g


def test_none_at_all_and_none_alive():
    empty = jax.tree.map(lambda a: a[:0], crowd(3))
    for g in (empty, crowd(5)):
        r = jax.jit(lambda g: render_linear(g, jnp.zeros(g.capacity, bool), VIEW, BASE, 1))(g)
        assert not np.any(r.linear)
        assert not bool(r.overflow)


def test_relative_error_over_a_high_dynamic_range():
    """10^4:1 radiance, bright lights behind nearly opaque dark surfaces: the default stop rule."""
    cfg, rng, n = IMPLEMENTATIONS["xla, counting"], np.random.default_rng(0), 400
    depth = np.sort(rng.uniform(2, 8, n))
    # The nearer half is dark, the farther half bright; transmittance falls gradually.
    radiance = np.where(np.arange(n) < n // 2, 1.0, 1e4)[:, None] * rng.uniform(0.5, 1, (n, 3))
    mean = np.c_[rng.uniform(-1, 1, (n, 2)) * depth[:, None] * 0.5, depth]
    values = {"mean": mean, "radiance": radiance, "logit": np.full(n, -1.5), "scales": 1.0}
    case = HardCase("bright behind dark", "", lambda: crowd(n, **values))
    g = gap(case, cfg)
    assert g.relative < 1e-3, g
