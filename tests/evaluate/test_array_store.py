"""What is looked at twice waits on disk where it would fill the memory, and scores the same."""

from pathlib import Path

import chex
import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import FitConfig
from p2gs_jax.evaluation import evaluate as evaluation
from p2gs_jax.evaluation.passes import ArrayStore
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Gaussians, Params, Photometry, Render, Scene, View


def test_arrays_beyond_the_bound_lie_on_disk_until_the_end():
    arrays = [np.random.default_rng(k).normal(size=(50, 3)).astype(np.float32) for k in range(3)]
    with ArrayStore(most_bytes=arrays[0].nbytes) as store:
        kept = [store.put(a) for a in arrays]
        assert store.bytes_held == arrays[0].nbytes
        assert store.put(kept[1]) is kept[1]
        files = [k.path for k in kept if k.path is not None]
        assert len(files) == 2
        for a, k in zip(arrays, kept, strict=True):
            assert k.read().tobytes() == a.tobytes()
    assert not any(Path(f).exists() for f in files)


@pytest.fixture
def shelves(monkeypatch):
    """Return the shelves that evaluations make from here on, and a function that bounds them."""
    made = []

    def bound(most_bytes):
        def make(usual):
            made.append(ArrayStore(most_bytes))
            return made[-1]

        monkeypatch.setattr(evaluation, "ArrayStore", make)

    return made, bound


def made_scene(folder):
    """Return two training views and one held out, of noise."""
    rng, views = np.random.default_rng(0), []
    K = np.array([[40, 0, 20], [0, 40, 17], [0, 0, 1]], np.float32)
    for k, split in enumerate(("train", "train", "test")):
        path = folder / f"{k}.png"
        cv2.imwrite(str(path), rng.integers(0, 256, (34, 40, 3), np.uint8))
        pose = np.eye(4, dtype=np.float32)
        views.append(View(path.name, path, "0", pose, K, 40, 34, split=split))
    points = np.zeros((0, 3), np.float32)
    return Scene(folder, "colmap", tuple(views), points, points.astype(np.uint8))


def judged(scene):
    """Return the metrics of a fit that is darker on one side, against references and truth."""
    store = ImageStore(scene.views, FitConfig().data)

    def shaded(gaussians, alive, camera):
        flat = jnp.ones((camera.height, camera.width), jnp.float32)
        linear = 0.2 * jnp.tile((flat * jnp.linspace(0.5, 1.5, camera.width))[..., None], 3)
        return Render(linear, flat, flat, jnp.int32(0), jnp.bool_(False), alive)

    shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3))
    gaussians = Gaussians(*(jnp.zeros(s, jnp.float32) for s in shapes))
    return evaluation.evaluate(
        Params(gaussians, Photometry(jnp.zeros(2), jnp.zeros(2), "log"), None),
        np.zeros(0, bool),
        scene,
        store,
        shaded,
        FitConfig(),
        reference=lambda row: store.get(row, 1)[0],
        radiance=lambda row: 0.01 + store.get(row, 1)[0],
    )


def test_an_evaluation_keeps_no_view_beyond_the_bound(tmp_path, shelves):
    made, bound = shelves
    scene = made_scene(tmp_path)
    bound(1 << 30)
    roomy = judged(scene)
    bound(0)
    tight = judged(scene)
    assert made[0].bytes_held > 3 * 34 * 40 * 3 * 4
    assert made[1].bytes_held == 0
    assert {"reference", "radiance"} <= set(tight)
    chex.assert_trees_all_equal(roomy, tight)
