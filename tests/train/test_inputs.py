"""Inputs of a step: photographs as they are stored, in the order of an epoch."""

import chex
import numpy as np
from tiny_scene import make_scene

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.train.image_gradient import decoded
from p2gs_jax.train.inputs import TrainingViews


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


def test_every_epoch_takes_every_view_once_in_an_order_of_its_own(tmp_path):
    scene = load_scene(make_scene(tmp_path / "scene", views=8, points=30), DataConfig())
    views = TrainingViews(ImageStore(scene.views, DataConfig()), scene.train_indices, 0)
    count = len(views)
    epochs = [[views.index_at(e * count + k) for k in range(count)] for e in range(2)]
    assert all(sorted(epoch) == list(range(count)) for epoch in epochs)
    assert epochs[0] != epochs[1]
