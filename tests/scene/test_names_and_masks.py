"""What the names of files say: the order of photographs, which files are masks, and of what."""

import dataclasses

import cv2
import numpy as np
import pytest
from scene.helpers import make_view, refused, write_image, write_rgba, write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import natural
from p2gs_jax.scene import ImageStore, load_scene
from p2gs_jax.scene.drives.tables import numbered
from p2gs_jax.scene.files import list_images
from p2gs_jax.scene.masks import attach_masks
from p2gs_jax.scene.pixels.decode import Room
from p2gs_jax.scene.rigid import time_order
from p2gs_jax.scene.sfm import features
from p2gs_jax.scene.sfm.features import pairs_by_name
from p2gs_jax.scene.split import assign_split
from p2gs_jax.types import Scene

CFG = DataConfig(test_every=0)


def test_numbers_in_names_count(tmp_path):
    names = [f"frame_{k}.jpg" for k in range(1, 101)]
    assert sorted(sorted(names), key=natural) == names
    pairs = pairs_by_name(sorted(names))
    assert {(names[k], names[k + 1]) for k in range(99)} <= {*pairs}
    views = tuple(dataclasses.replace(make_view(tmp_path / n), name=n) for n in sorted(names))
    held = [v.name for v in assign_split(views, 8) if v.split == "test"]
    assert sorted(held, key=natural) == names[::8]
    assert [v.name for v in sorted(views, key=time_order)] == names
    # A digit that is not a decimal is no number.
    for name in ("3.bin", "\u00b2.bin", "10.bin"):
        (tmp_path / name).touch()
    assert [*numbered(tmp_path, (".bin",))] == [3, 10]


def test_any_name_can_be_matched_with_any_other(tmp_path):
    names, rng = ["IMG (1).png", "#2.png", "c\td.png", "e.png"], np.random.default_rng(0)
    picture = cv2.blur(rng.integers(0, 256, (160, 200), np.uint8), (3, 3))
    for k, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), np.roll(picture, 2 * k, 1))
    features.quiet_colmap()
    database = features.kept_features(tmp_path / "kept", tmp_path, {(): names}, print)
    features.match_kept(database, names, [(names[0], names[1]), (names[2], names[3])], print)
    with features.opened(database) as db:
        assert {image.name for image in db.read_all_images()} == {*names}
        assert db.num_verified_image_pairs() == 2


MASKS = [
    *("masks/im 0.png", "masks/im 0.png.png", "masks/IM 0.PNG", "masks/im 0.jpg"),
    *("masks/im 0_mask.png", "masks/im 0.mask.png", "masks/mask_im 0.png", "mask/im 0.png"),
    *("images/masks/im 0.png", "images/im 0_mask.png", "images/dynamic_mask_im 0.png"),
    *("Masks/im 0.png", "dynamic_masks/im 0.png", "images/im 0.png.png"),
]


@pytest.mark.parametrize("place", MASKS)
def test_masks_are_found_as_others_call_them(tmp_path, place):
    write_tiny_model(tmp_path)
    write_image(tmp_path / place, 0)
    scene = load_scene(tmp_path, CFG)
    assert [view.mask_path for view in scene.views] == [tmp_path / place, None]
    # What is a mask is no photograph.
    found = [p.name for p in list_images(tmp_path / "images")]
    assert found == ["im 0.png", "im 1.png"]


def test_masks_of_several_cameras_are_not_mixed_up(tmp_path):
    views = []
    for camera in ("a", "b"):
        write_image(tmp_path / "images" / camera / "0.jpg")
        write_image(tmp_path / "masks" / camera / "0_mask.png")
        # Names may be relative to the folder of the camera.
        views.append(make_view(tmp_path / "images" / camera / "0.jpg"))
    found, _ = attach_masks(Scene(tmp_path, "transforms", tuple(views), np.zeros((0, 3)), None))
    assert [v.mask_path.parent.name for v in found] == ["a", "b"]


def test_masks_that_are_of_nothing_are_named_and_a_mask_may_be_a_photograph(tmp_path):
    write_tiny_model(tmp_path)
    write_image(tmp_path / "masks" / "other.png")
    (note,) = load_scene(tmp_path, CFG).notes
    assert note.endswith(
        "masks holds 1 files, none is of a photograph: name a mask as its photograph"
    )
    # Nothing there is called as this would be without the word.
    write_image(tmp_path / "images" / "venetian_mask.png")
    assert len(list_images(tmp_path / "images")) == 3


def test_the_alpha_of_a_mask_counts(tmp_path):
    write_tiny_model(tmp_path)
    for value in (0, 90):
        write_rgba(tmp_path / "masks" / "im 0.png", value)
        valid = ImageStore(load_scene(tmp_path, CFG).views, CFG).get(0)[1]
        inside = np.zeros((30, 40))
        inside[7:-7, 10:-10] = 1
        np.testing.assert_array_equal(valid, inside)


def test_alpha_says_something_where_it_varies(tmp_path):
    write_tiny_model(tmp_path)

    def write(alpha):
        for k in range(2):
            pixels = np.full((30, 40, 4), (90, 90, 90, alpha), np.uint8)
            cv2.imwrite(str(tmp_path / "images" / f"im {k}.png"), pixels)

    write(255)
    scene = load_scene(tmp_path, CFG)
    assert ImageStore(scene.views, CFG).backdrop is None
    assert not any("alpha" in note or "--background" in note for note in scene.notes)
    scene = load_scene(tmp_path, DataConfig(background="black"))
    assert "--background black shows nowhere" in scene.notes[-1]
    write(0)
    with refused("im 0.png is transparent everywhere", "--data.alpha ignore"):
        load_scene(tmp_path, CFG)
    assert "ignored" in load_scene(tmp_path, DataConfig(alpha="ignore")).notes[-1]
    write_rgba(tmp_path / "images" / "im 1.png")
    assert ImageStore(load_scene(tmp_path, CFG).views, CFG).backdrop is not None


def test_photographs_are_decoded_together_as_far_as_memory_goes():
    room = Room(100)
    with room.taking(60), room.taking(40):
        assert room._taken == 100
    with room.taking(1000):  # one is always let in
        assert room._taken == 1000
    assert room._taken == 0
