"""Steps that share programs, and the time that counts as waiting for one."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from p2gs_jax import FitConfig, preset, with_fields
from p2gs_jax.render.capacity import Capacity
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.step import PROGRAMS, Key, Step, StepPrograms

COARSE = Key((120, 80), 500, Capacity(4096, 4096), 3, "uint16")
FULL = COARSE._replace(size=(240, 160), capacity=Capacity(8192, 4096), pixels="uint8")
SHAPES = tuple(np.zeros(k) for k in range(1, 5))


def test_a_program_that_reads_a_setting_outside_its_key_raises():
    """Fits share programs: a default must never stand in for the value of a fit."""
    step = Step(preset("robust"), make_optimizer(FitConfig()), 1.0)
    for name in PROGRAMS:
        cfg = step.settings(name)["cfg"]
        assert cfg.render == FitConfig().render
        for missing in ("train", "densify", "data"):
            with pytest.raises(AttributeError, match=missing):
                getattr(cfg, missing)
    with pytest.raises(AttributeError, match="model"):
        _ = step.settings("differentiate")["cfg"].photometry.model
    with pytest.raises(AttributeError, match="curve"):
        _ = step.settings("advance")["cfg"].photometry.curve


class Traced:
    """A stand-in for a step that counts compilations and computes nothing."""

    def __init__(self, cfg: FitConfig):
        real = Step(cfg, make_optimizer(cfg), 1.0)
        self.settings, self.made, self.gate = real.settings, [], threading.Event()
        self.gate.set()

    def lowered(self, name, *arguments, capacity, degree):
        def compile():
            self.gate.wait(10)
            self.made.append(name)
            return name

        return SimpleNamespace(compile=compile)

    def chained(self, *programs):
        return programs


@pytest.fixture
def programs():
    made = StepPrograms()
    yield made
    made.close()


def under(curve="srgb", model="view_exposure", seed=0, **optimizer):
    fields = {"train.seed": seed, "photometry.curve": curve, "photometry.model": model}
    return with_fields(FitConfig(), fields | {f"optimizer.{k}": v for k, v in optimizer.items()})


def test_levels_share_the_programs_per_gaussian(programs):
    step = Traced(under())
    for key in (COARSE, FULL, COARSE):
        assert programs.get(step, key, *SHAPES) == ("show", "differentiate", "advance")
    assert sorted(step.made) == ["advance", "differentiate", "differentiate", "show"]


@pytest.mark.parametrize(("visible_only", "images"), [(True, 1), (False, 2)])
def test_a_larger_population_keeps_the_program_of_the_image_unless_views_show_all(
    programs, visible_only, images
):
    step = Traced(under(visible_only=visible_only))
    for slots in (5000, 9000):
        programs.get(step, COARSE._replace(slots=slots), *SHAPES)
    assert sorted(step.made) == ["advance"] * 2 + ["differentiate"] * images + ["show"] * 2


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ({"curve": "power"}, ["differentiate"]),
        ({"model": "view_exposure_gamma"}, ["advance"]),
        ({"scales": 0.5}, ["advance"]),
        ({"seed": 7}, []),
        ({}, []),
    ],
)
def test_programs_begun_before_exposures_are_known_are_used_if_they_fit(programs, change, again):
    early, step = Traced(under()), Traced(under(**change))
    programs.expect(early, COARSE, *SHAPES)
    programs.get(step, COARSE, *SHAPES)
    assert sorted(step.made) == again


def test_without_a_curve_only_programs_of_gaussians_begin(programs):
    step = Traced(under())
    programs.expect(step, COARSE, *SHAPES, images=False)
    while len(step.made) < 2:
        time.sleep(0.01)
    assert sorted(step.made) == ["advance", "show"]
    programs.get(step, COARSE, *SHAPES)
    assert step.made[2:] == ["differentiate"]


def test_only_waiting_is_counted(programs):
    step = Traced(under())
    programs.get(step, COARSE, *SHAPES)
    before = programs.waited_s
    programs.get(step, COARSE, *SHAPES)
    assert programs.waited_s == before
    step.gate.clear()
    threading.Timer(0.05, step.gate.set).start()
    programs.get(step, FULL, *SHAPES)
    assert programs.waited_s > before
