"""What the alpha channel of photographs does: a background, a mask, or nothing; it is told."""

import cv2
import numpy as np
import pytest
from scene.helpers import write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.run.scene_file import read_scene, write_scene
from p2gs_jax.scene import ImageStore, load_scene
from p2gs_jax.scene.masks import background_color, has_alpha
from p2gs_jax.train.inputs import TrainingViews

RNG = np.random.default_rng(0)


@pytest.fixture
def cutouts(tmp_path):
    """Write four photographs 40x30, the first three with alpha; return their folder and values."""
    write_tiny_model(tmp_path, n=4)
    held = []
    for k in range(3):
        bgra = RNG.integers(0, 256, (30, 40, 4), dtype=np.uint8)
        bgra[:10, :, 3], bgra[10:20, :, 3] = 0, 255
        assert cv2.imwrite(str(tmp_path / "images" / f"im {k}.png"), bgra)
        held.append(bgra[..., [2, 1, 0, 3]].astype(np.float64) / 255)
    return tmp_path, held


def store_of(root, **options):
    cfg = DataConfig(**options)
    return ImageStore(load_scene(root, cfg).views, cfg)


def test_a_background_that_shows_nowhere_is_said(tmp_path):
    write_tiny_model(tmp_path, n=2)
    assert not any("--background" in n for n in load_scene(tmp_path, DataConfig()).notes)
    scene = load_scene(tmp_path, DataConfig(background="black"))
    assert "--background black shows nowhere" in scene.notes[-1]


@pytest.mark.parametrize(
    ("background", "color"),
    [
        ("white", (1, 1, 1)),
        ("black", (0, 0, 0)),
        ("0.2,0.4,0.6", (0.2, 0.4, 0.6)),
        ("random", (1, 1, 1)),
    ],
)
def test_photographs_are_composited(cutouts, background, color):
    root, held = cutouts
    store = store_of(root, background=background)
    for k, rgba in enumerate(held):
        ldr, mask = store.get(k)
        alpha = rgba[..., 3:]
        assert np.allclose(ldr, alpha * rgba[..., :3] + (1 - alpha) * color, atol=2e-5)
        assert mask.min() == 1.0
    assert np.allclose(store.get(3)[0], 103 / 255)
    assert store.alpha(3).min() == 65535


def test_transparent_pixels_do_not_colour_their_neighbours(cutouts):
    root, held = cutouts
    ldr, _ = store_of(root, background="black").get(0, 2)
    premultiplied = held[0][..., :3] * held[0][..., 3:]
    expected = premultiplied.reshape(15, 2, 20, 2, 3).mean((1, 3))
    assert np.allclose(ldr, expected, atol=2e-5)


def test_as_a_mask_and_not_at_all(cutouts):
    root, held = cutouts
    masked = store_of(root, alpha="mask")
    assert masked.backdrop is None
    assert masked.alpha(0) is None
    ldr, mask = masked.get(0)
    assert np.array_equal(mask, (held[0][..., 3] >= 0.5).astype(np.float32))
    assert np.allclose(ldr, held[0][..., :3])
    ldr, mask = store_of(root, alpha="ignore").get(0)
    assert mask.min() == 1.0
    assert np.allclose(ldr, held[0][..., :3])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "3 of 4 photographs have an alpha channel: photographs and renders are shown"),
        ({"background": "random"}, "shown over a random colour at every step, and white to judge"),
        ({"alpha": "mask"}, "transparent pixels are left out"),
        ({"alpha": "ignore"}, "it is ignored"),
    ],
)
def test_it_is_always_told(cutouts, options, said):
    assert said in load_scene(cutouts[0], DataConfig(**options)).notes[-1]


def test_exposures_and_seeds_see_opaque_pixels_only(cutouts):
    root, held = cutouts
    store = store_of(root)
    opaque = store.only_opaque()
    assert np.array_equal(opaque.get(1)[1], (held[1][..., 3] == 1).astype(np.float32))
    assert opaque.get(3)[1].min() == store.get(1)[1].min() == 1.0


def test_scenes_without_alpha_are_as_they_were(tmp_path):
    write_tiny_model(tmp_path, n=3)
    scene = load_scene(tmp_path, DataConfig())
    store = ImageStore(scene.views, DataConfig())
    assert not any("alpha" in note for note in scene.notes)
    assert store.backdrop is None
    assert store.only_opaque() is store
    batch = TrainingViews(store, range(3), 0).batch(0, 1, 5)
    assert batch.alpha is None
    assert batch.backdrop is None
    assert batch.ldr.dtype == np.uint8


def test_random_backgrounds_follow_from_seed_and_step(cutouts):
    root, _ = cutouts
    store = store_of(root, background="random")
    views = TrainingViews(store, range(3), 0)
    drawn = [views.batch(0, 1, step).backdrop for step in range(20)]
    assert np.array_equal(drawn[7], TrainingViews(store, range(3), 0).batch(1, 1, 7).backdrop)
    assert not np.array_equal(drawn[7], TrainingViews(store, range(3), 1).batch(0, 1, 7).backdrop)
    assert len({tuple(color) for color in drawn}) == 20
    assert 0 <= np.min(drawn) < 0.3
    assert 0.7 < np.max(drawn) <= 1
    fixed = TrainingViews(store_of(root), range(3), 0)
    assert np.array_equal(fixed.batch(0, 1, 3).backdrop, [1, 1, 1])
    # Premultiplied, with the alpha beside it.
    batch = fixed.batch(0, 1, 3)
    assert batch.ldr.dtype == batch.alpha.dtype == np.uint16
    assert (batch.ldr.astype(int) <= batch.alpha[..., None].astype(int) + 1).all()


def test_a_run_remembers_what_alpha_meant(cutouts, tmp_path_factory):
    root, _ = cutouts
    run = tmp_path_factory.mktemp("run")
    scene = load_scene(root, DataConfig())
    write_scene(run, scene)
    again = read_scene(run, root)
    assert [view.alpha for view in again.views] == [view.alpha for view in scene.views]
    assert again.split_by == scene.split_by


def test_which_files_have_alpha(cutouts, tmp_path):
    folder = cutouts[0] / "images"
    assert has_alpha(folder / "im 0.png")
    assert not has_alpha(folder / "im 3.png")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG")
    assert not has_alpha(tmp_path / "broken.png")


@pytest.mark.parametrize("text", ["blue", "1,1", "0.5,0.5,1.5", "0,0,nan", "", "1,1,1,1"])
def test_colours_that_are_none(text):
    with pytest.raises(UserError, match="is not a valid colour"):
        background_color(DataConfig(background=text))


def test_a_mask_of_another_shape_is_refused(cutouts):
    root, _ = cutouts
    (root / "masks").mkdir()
    cv2.imwrite(str(root / "masks" / "im 0.png"), np.full((30, 30), 255, np.uint8))
    with pytest.raises(UserError, match=r"wrong size: the mask .*im 0.png is 30x30"):
        store_of(root).get(0)
