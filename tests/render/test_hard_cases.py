"""Hard cases over every implementation, against the float64 oracle (benchmarks/hard_cases)."""

import dataclasses
import functools

import numpy as np
import pytest

from benchmarks import hard_cases
from benchmarks.hard_cases import CASES, VIEW, HardCase, crowd, gap

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
    [pytest.param(c, id=c.name, marks=() if c.view is VIEW else pytest.mark.slow) for c in CASES],
)
def test_hard_case(case: HardCase, implementation: str):
    cfg = IMPLEMENTATIONS[implementation]
    if case.name.startswith("10^5") and implementation != "xla, counting":
        pytest.skip("interpreted kernels take a minute")
    g = gap(case, cfg, oracle(case.name))
    assert g.finite, case.expect
    assert g.silent == case.unseen, case.expect
    # The stop rule may add its error, and an undecided pair moves gradients by the cutoff.
    stop = cfg.stop_error
    assert g.value <= case.value_tolerance + stop, g
    assert g.relative <= 1e-3, g
    assert g.gradient <= case.gradient_tolerance + 4 * stop + g.undecided * cfg.alpha_cutoff, g


def test_relative_error_over_a_high_dynamic_range():
    """The default stop rule keeps bright lights behind many faint dark Gaussians (10^4:1)."""
    cfg, rng, n = IMPLEMENTATIONS["xla, counting"], np.random.default_rng(0), 400
    depth = np.sort(rng.uniform(2, 8, n))
    # The nearer half is dark, the farther half bright; transmittance falls gradually.
    radiance = np.where(np.arange(n) < n // 2, 1.0, 1e4)[:, None] * rng.uniform(0.5, 1, (n, 3))
    mean = np.c_[rng.uniform(-1, 1, (n, 2)) * depth[:, None] * 0.5, depth]
    values = {"mean": mean, "radiance": radiance, "logit": np.full(n, -1.5), "scales": 1.0}
    g = gap(HardCase("bright behind dark", "", lambda: crowd(n, **values)), cfg)
    assert g.relative < 1e-3, g
