"""The scenes of `bench levels`: repeatable, and with the lists that fits have."""

import jax
import numpy as np
import pytest

from p2gs_jax.bench import levels
from p2gs_jax.bench.fit_scenes import FITTED, room, town_level
from p2gs_jax.config import FitConfig

NUMERICS = {"psnr": 90.0, "gradient_99": 1e-6}
SMALL = {"width": 240, "points": 15_000}


def opacities(scene):
    return 1 / (1 + np.exp(-np.asarray(scene.gaussians.opacity_logits, np.float64)))


@pytest.mark.parametrize("make", [lambda: town_level(2, width=120, points=600), room])
def test_scenes_are_the_same_every_time(make):
    a, b = make(), make()
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(a.gaussians))


def test_levels_differ_in_size_and_have_the_population_of_their_time():
    scenes = [town_level(s, width=240, points=3000) for s in (4, 2, 1)]
    assert [s.camera.width for s in scenes] == [60, 120, 240]
    counts = [s.gaussians.capacity for s in scenes]
    assert counts == sorted(counts)
    assert counts[-1] == round(3000 * FITTED.grown)
    spread = [opacities(s).std() for s in scenes]
    assert spread == sorted(spread)
    # The end of a fit, as measured: half of the Gaussians hide little, some nearly all.
    low, middle, high = np.percentile(opacities(scenes[-1]), (25, 50, 95))
    assert 0.01 < low < 0.05
    assert 0.07 < middle < 0.17
    assert 0.6 < high < 0.9


@pytest.mark.slow
def test_coarse_levels_of_a_town_have_the_longest_lists():
    coarse, fine = (levels.lists(town_level(s, **SMALL), FitConfig()) for s in (4, 1))
    assert coarse.longest > 1500
    assert coarse.entries / coarse.tiles > 400
    assert coarse.quantiles[2] > 5 * coarse.quantiles[0]
    assert 80 < fine.entries / fine.tiles < 300
    assert 300 < fine.longest < coarse.longest


def test_lists_of_the_room_are_deep():
    found = levels.lists(room(), FitConfig())
    assert 150 < found.entries / found.tiles < 300
    assert 500 < found.longest < 1200


def test_the_gate_gets_ratios_and_what_is_robust_of_the_accuracy():
    lists = levels.Lists(1, 2, 2, (2.0, 2.0, 2.0))
    level = levels.Level("town", 3, (16, 8), lists, {"both": 4.0}, {"both": 0.5}, NUMERICS)
    assert levels.gate_rows([level]) == {"town": {"both": 0.5, "numerics gradient_99": 1e-6}}
