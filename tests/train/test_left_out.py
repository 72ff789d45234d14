"""What no static scene explains is found during a fit, left out of its steps, and remembered."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loop_harness import SHORT, Harness, Programs
from moving_box import RENDER, drive_format, make_world, write_photographs

from p2gs_jax.config import DataConfig, FitConfig
from p2gs_jax.errors import DivergenceError
from p2gs_jax.evaluate.unexplained import Unexplained
from p2gs_jax.scene import ImageStore, drives, load_scene
from p2gs_jax.scene.drives.objects import (
    object_mask,
)
from p2gs_jax.sweep import with_fields
from p2gs_jax.train import left_out
from p2gs_jax.train.left_out import MOST_OF_A_VIEW, Looked, bounded, described, look
from p2gs_jax.train.state import Fault, FitState
from p2gs_jax.train.views import TrainingViews, resized
from p2gs_jax.types import Measured, Params, Photometry, Population

MASKING = with_fields(
    SHORT, {"dynamics.unexplained": "mask", "dynamics.unexplained_at": [0.3, 0.6]}
)
KINDS = {
    "photometry.curve": "srgb",
    "photometry.select": False,
    "photometry.model": "view_exposure",
    "render.sh_degree": 0,
}


@pytest.fixture(scope="module")
def folder(made_once):
    return made_once("moving_box", write_photographs)


@pytest.fixture(scope="module")
def scene(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(drives.FORMATS, "pandaset", drive_format())
        return load_scene(folder, DataConfig(own_car=False, format="pandaset"))


@pytest.fixture
def views(scene):
    store = ImageStore(scene.views, DataConfig())
    yield TrainingViews(store, scene.train_indices, 0)
    store.close()


def state_of(gaussians, exposures):
    photometry = Photometry(jnp.asarray(np.log(exposures), jnp.float32), jnp.zeros(len(exposures)))
    alive = np.ones(gaussians.capacity, bool)
    zeros = [jnp.zeros(gaussians.capacity) for _ in range(2)]
    params, population = Params(gaussians, photometry), Population(jnp.asarray(alive), *zeros)
    return FitState(params, (), population, jnp.int32(0), Fault.none())


@pytest.fixture(scope="module")
def taken(scene):
    """Exposures of the training views."""
    return make_world().exposures[[view.frame for view in scene.training_views]]


CFG = with_fields(FitConfig(), KINDS)
CFG = dataclasses.replace(CFG, render=dataclasses.replace(RENDER, radiance=CFG.render.radiance))


def box_in(scene, view, mask):
    return object_mask(view, scene.objects, mask.shape[1], mask.shape[0], margin=0.1)


def test_what_crosses_a_scene_is_found_without_its_box(scene, views, taken):
    looked = look(state_of(make_world().wall, taken), views, CFG, 1)
    assert looked.whole == 0
    inside = outside = area = box = 0
    for row, found in looked.found.items():
        there = box_in(scene, views.store.views[views.rows[row]], found.mask)
        inside += (found.mask & there).sum()
        outside += (found.mask & ~there).sum()
        box += there.sum()
        area += there.size
    assert inside > 0.6 * box
    assert outside < 0.005 * area


def test_what_is_only_fitted_badly_stays(scene, views, taken):
    """A third of the scene has a wrong colour: it is wrong at all times."""
    wall = make_world().wall
    wrong = np.asarray(wall.means)[:, 0] > 1.5
    assert 0.2 < wrong.mean() < 0.6
    sh = np.asarray(wall.sh) + 3.0 * wrong[:, None, None]
    looked = look(state_of(dataclasses.replace(wall, sh=jnp.asarray(sh)), taken), views, CFG, 1)
    outside = []
    for row, found in looked.found.items():
        there = box_in(scene, views.store.views[views.rows[row]], found.mask)
        outside.append((found.mask & ~there).mean())
    assert np.mean(outside) < 0.01


def test_a_view_of_which_too_much_would_be_left_out_stays_whole():
    masks = [np.arange(100).reshape(10, 10) < count for count in (90, 20)]
    found = {k: Unexplained(mask, float(mask.mean())) for k, mask in enumerate(masks)}
    looked = bounded(found)
    assert looked.whole == 1
    assert found[0].share > MOST_OF_A_VIEW
    assert not looked.found[0].mask.any()
    assert looked.found[0].share == 0
    assert looked.found[1] is found[1]
    said = described(looked, 40)
    assert "After step 40: 10.0%" in said
    assert "1 views stay whole" in said
    assert "stay whole" not in described(Looked({1: found[1]}, 0), 40)


def test_hidden_pixels_have_no_weight_and_come_back(views):
    before = views.batch(2, 1)
    height, width = before.mask.shape
    hidden = np.zeros((height // 2, width // 2), bool)
    hidden[10:20, 5:30] = True
    views.hide({2: hidden, 3: np.zeros_like(hidden)})
    batch = views.batch(2, 1)
    assert not batch.mask[20:40, 10:60].any()
    batch.mask[20:40, 10:60] = True
    np.testing.assert_array_equal(batch.mask, before.mask)
    shrunk = views.batch(2, 2)
    np.testing.assert_array_equal(shrunk.mask, ~hidden)
    # What a compiled step was made for does not change.
    described_as = [jax.tree.map(lambda a: (a.shape, a.dtype), b) for b in (before, batch)]
    assert described_as[0] == described_as[1]
    for row in (1, 3):
        assert views.batch(row, 1).mask is views.store.stored(views.rows[row], 1)[1]
    views.hide({})
    assert views.batch(2, 1).mask.all()


def test_measured_depths_are_left_out_with_their_pixels(views):
    places = np.array([[0.1, 0.1], [0.6, 0.6], [1.0, 1.0]], np.float32)
    depths = np.array([3, 4, 5], np.float32)
    views.measured = [Measured(places, depths)] * len(views)
    hidden = np.zeros((4, 4), bool)
    hidden[2, 2] = True
    views.hide({0: hidden})
    np.testing.assert_array_equal(views.batch(0, 1).measured.depths, [3, 0, 5])
    np.testing.assert_array_equal(views.batch(1, 1).measured.depths, depths)


def test_masks_of_other_sizes():
    mask = np.eye(2, dtype=bool)
    np.testing.assert_array_equal(resized(mask, 4, 4), np.kron(mask, np.ones((2, 2), bool)))
    np.testing.assert_array_equal(resized(np.kron(mask, np.ones((2, 2), bool)), 2, 2), mask)


# ------------------------------------------------------------------------------ in the loop


class Looks:
    """Looks that find something else after every step."""

    def __init__(self, monkeypatch):
        self.steps = []
        self.hidden = []
        monkeypatch.setattr(left_out, "look", self.look)
        hide = lambda views, masks: self.hidden.append(masks)  # noqa: E731
        monkeypatch.setattr("loop_harness.Views.hide", hide, raising=False)
        monkeypatch.setattr("loop_harness.Views.rows", (5, 6, 7, 8), raising=False)

    def look(self, state, views, cfg, shrink):
        self.steps.append(int(state.step))
        mask = np.random.default_rng(int(state.step)).random((6, 6)) < 0.2
        return Looked({row: Unexplained(mask, float(mask.mean())) for row in range(4)}, 0)


@pytest.fixture
def harness(monkeypatch, tmp_path):
    return Harness(monkeypatch, tmp_path)


def test_looks_are_where_they_are_asked_for(harness, monkeypatch):
    looks = Looks(monkeypatch)
    result, programs = harness.run(MASKING)
    assert looks.steps == [30, 60]
    assert set(result.left_out) == {5, 6, 7, 8}
    assert len(programs.made) == 1
    assert [said for said in harness.said if "no static scene" in said] == [
        s for s in harness.said if s.startswith(("After step 30:", "After step 60:"))
    ]
    assert len(looks.hidden) == 2


def test_it_costs_nothing_where_it_is_not_asked_for(harness, monkeypatch, tmp_path):
    looks = Looks(monkeypatch)
    result, _ = harness.run(SHORT)
    assert result.left_out is None
    assert not looks.steps
    assert not looks.hidden
    assert "looking" not in result.seconds
    assert not (tmp_path / "left_out.npz").exists()


def test_a_resumed_run_leaves_out_what_it_left_out(harness, monkeypatch):
    cut = with_fields(MASKING, {"train.checkpoint_every_s": 0.0})
    looks = Looks(monkeypatch)
    programs = Programs(harness.clock)
    programs.breaks_at = 47
    with pytest.raises(DivergenceError, match="Step 48"):
        harness.run(cut, programs=programs)
    before = looks.hidden[-1]
    assert harness.checkpoints.latest_step() == 45
    looks.steps.clear()
    looks.hidden.clear()
    result, _ = harness.run(cut, resume=True)
    # At first what was left out before; then the look that comes next, and no other.
    assert looks.steps == [60]
    assert len(looks.hidden) == 2
    for row, mask in looks.hidden[0].items():
        np.testing.assert_array_equal(mask, before[row])
    assert result.host.looked_step == 60


def test_a_look_after_the_checkpoint_is_taken_again(harness, monkeypatch):
    cut = with_fields(MASKING, {"train.checkpoint_every_s": 0.0})
    looks = Looks(monkeypatch)
    harness.run(cut)
    harness.checkpoints.discard_after(55)
    looks.steps.clear()
    harness.run(cut, resume=True)
    assert looks.steps == [60]
    # Anew, from the beginning.
    looks.steps.clear()
    looks.hidden.clear()
    harness.checkpoints.saved.clear()
    harness.run(cut)
    assert looks.steps == [30, 60]
    assert len(looks.hidden) == 2
