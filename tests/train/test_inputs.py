"""Inputs of a step: photographs as they are stored, and batches of views of one size."""

import chex
import jax
import numpy as np
from tiny_scene import make_scene

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.train import inputs
from p2gs_jax.train.image_gradient import decoded
from p2gs_jax.train.inputs import TrainingViews, batches_of, stacked


def test_photographs_travel_as_integers(tmp_path):
    scene = load_scene(make_scene(tmp_path / "scene", views=3, points=30), DataConfig())
    store = ImageStore(scene.views, DataConfig())
    views = TrainingViews(store, scene.train_indices, 0)
    for shrink, kind in ((1, np.uint8), (2, np.uint16)):
        batch = views.batch(0, shrink)
        assert isinstance(batch.ldr, np.ndarray)
        assert batch.ldr.dtype == kind
        assert batch.mask.dtype == bool
        expected = store.get(scene.train_indices[0], shrink)
        chex.assert_trees_all_close(decoded(batch), expected, atol=1e-7)


def test_every_view_of_an_epoch_is_in_a_batch_of_its_own_size():
    order = np.random.default_rng(0).permutation(11)
    kinds = ["wide" if view < 7 else "tall" for view in range(11)]
    batches = batches_of(order, kinds, 3)
    assert len(batches) == 3 + 2
    assert {view for batch in batches for view in batch} == set(range(11))
    assert all(len(batch) == 3 and len({kinds[v] for v in batch}) == 1 for batch in batches)
    assert all(len(set(batch)) == 3 for batch in batches)


def test_a_size_with_fewer_views_than_a_batch_repeats_them():
    assert batches_of(np.array([1, 0]), ["a", "a"], 4) == [(1, 0, 1, 0)]


def test_pixels_of_8_and_16_bits_become_one_type_of_the_same_values():
    fine = stacked([np.array([0, 255], np.uint8), np.array([7, 65535], np.uint16)])
    assert fine.dtype == np.uint16
    assert fine.tolist() == [[0, 65535], [7, 65535]]


def test_on_a_gpu_photographs_of_one_level_stay_there(tmp_path, monkeypatch):
    monkeypatch.setattr(inputs, "device_bytes", lambda: 1 << 30)
    scene = load_scene(make_scene(tmp_path / "scene", views=3, points=30), DataConfig())
    views = TrainingViews(ImageStore(scene.views, DataConfig()), scene.train_indices, 0)
    first, again = (views.batch(0, 2).ldr for _ in range(2))
    assert isinstance(first, jax.Array)
    assert again is first
    views.batch(0, 1)
    assert views.batch(0, 2).ldr is not first
    monkeypatch.setattr(inputs, "device_bytes", lambda: first.nbytes)
    views = TrainingViews(views.store, scene.train_indices, 0)
    assert isinstance(views.batch(0, 2).ldr, np.ndarray)
