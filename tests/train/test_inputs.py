"""Inputs of a step: stored photographs, batches of one size, and canvases of compiled sizes."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from splats import rendered
from tiny_scene import make_scene

from p2gs_jax import load_scene, loss_terms
from p2gs_jax.config import CameraFormation, DataConfig, FitConfig, PhotometryConfig
from p2gs_jax.render.capacity import MOST_CANVASES, canvases
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.train import inputs
from p2gs_jax.train.image_gradient import compared, decoded
from p2gs_jax.train.inputs import TrainingViews, batches_of, stacked
from p2gs_jax.types import Batch, Camera, Photometry


def test_batches_hold_photographs_as_integers(tmp_path):
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


def test_every_view_of_an_epoch_is_in_a_batch_of_one_size():
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


def test_photographs_of_the_current_level_stay_on_a_gpu_if_they_fit(tmp_path, monkeypatch):
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


SIDE = st.integers(40, 2000)


@given(st.lists(st.tuples(SIDE, SIDE), min_size=1, max_size=12))
def test_few_canvases_hold_all_sizes(sizes):
    canvas = canvases(sizes)
    assert canvas.keys() == set(sizes)
    assert all(w <= canvas[w, h][0] and h <= canvas[w, h][1] for w, h in sizes)
    assert len(set(canvas.values())) <= MOST_CANVASES
    assert canvases(sizes[:1] * 3) == {sizes[0]: sizes[0]}


def test_canvases_of_a_collection_add_less_than_a_tenth():
    draw = np.random.default_rng(0)
    ratios = draw.choice([4 / 3, 3 / 2, 16 / 9, 3 / 4, 2 / 3], 135, p=[0.4, 0.3, 0.05, 0.15, 0.1])
    sizes = [(960, round(960 / r)) for r in ratios * draw.normal(1, 0.004, 135)]
    canvas = canvases(sizes)
    assert len(canvas) > 30
    assert sum(np.prod(canvas[s]) for s in sizes) < 1.1 * sum(map(np.prod, sizes))


def test_a_photograph_on_a_larger_canvas_has_the_same_loss():
    camera = CameraFormation("front", ((-0.4, 0.1, 0.05),))
    cfg = FitConfig(photometry=PhotometryConfig(cameras=(camera,)))
    rng, terms, found = np.random.default_rng(0), loss_terms(cfg), []
    ldr, linear = rng.random((2, 14, 17, 3), np.float32)
    mask = rng.random((14, 17)) > 0.1
    photometry = Photometry(jnp.zeros(1), jnp.zeros(1), cameras=(0,))
    for below, right, size in ((0, 0, None), (5, 3, jnp.array([17.0, 14.0]))):
        shape = (14 + below, 17 + right)
        padded = rng.random((*shape, 3), np.float32)
        padded[:14, :17] = linear
        photograph = (np.pad(a, [(0, below), (0, right), (0, 0)][: a.ndim]) for a in (ldr, mask))
        view = Camera(jnp.eye(4), jnp.eye(3), *shape[::-1])
        batch = Batch(view, *photograph, jnp.int32(0), size=size)
        shown, target = compared(rendered(padded), batch, photometry, None, cfg)
        found.append({name: terms[name](shown, target, None) for name in ("l1", "dssim")})
    chex.assert_trees_all_close(*found, rtol=1e-5)
