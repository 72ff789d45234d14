"""Detection of formats, EXIF, masks, alpha, names of files, and sizes of pictures."""

import builtins
import dataclasses
import errno
import io
import os
import struct
import zlib

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scene.helpers import make_view, refused, write_image, write_rgba, write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import natural
from p2gs_jax.run.scene_file import read_scene, write_scene
from p2gs_jax.scene import ImageStore, PhotographsAlone, find_scene, load_scene
from p2gs_jax.scene.convert.readers import ExifSettings, exif_evs, read_exif_settings
from p2gs_jax.scene.drives.tables import numbered
from p2gs_jax.scene.files import image_size, list_images
from p2gs_jax.scene.masks import attach_masks, background_color, has_alpha
from p2gs_jax.scene.pixels.decode import Room
from p2gs_jax.scene.rigid import time_order
from p2gs_jax.scene.sfm import features
from p2gs_jax.scene.sfm.features import pairs_by_name
from p2gs_jax.scene.split import assign_split
from p2gs_jax.train.inputs import TrainingViews
from p2gs_jax.types import Scene

CFG = DataConfig()
RNG = np.random.default_rng(0)


def store_of(root, **options):
    cfg = DataConfig(**options)
    return ImageStore(load_scene(root, cfg).views, cfg)


@pytest.mark.parametrize("field", ["every", "max_frames", "max_width"])
def test_numbers_out_of_range_are_refused(tmp_path, field):
    root = write_tiny_model(tmp_path).parents[1]
    with refused(f"--{field.replace('_', '-')} must be at least"):
        load_scene(root, DataConfig(**{field: 0}))


def test_results_among_photographs_alone_are_refused(tmp_path):
    write_image(tmp_path / "0.png")
    with refused("holds the photographs"):
        load_scene(tmp_path, CFG, tmp_path / "cache")
    assert [path.name for path in tmp_path.iterdir()] == ["0.png"]


def test_results_below_searched_photographs_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("p2gs_jax.scene.convert_photographs", lambda *_: pytest.fail("apart"))
    write_image(tmp_path / "alone" / "0.png")
    write_image(tmp_path / "images" / "front" / "0.png")
    (tmp_path / "link").symlink_to(tmp_path / "images")
    for run in ("images/run", "images/front/a/run", "link/run"):
        with refused("among them"):
            load_scene(tmp_path, CFG, tmp_path / run / "cache")
    with refused("among them"):
        load_scene(tmp_path, dataclasses.replace(CFG, images="."), tmp_path / "run" / "cache")
    for root, run in (("", "run"), ("", "../run"), ("alone", "alone/run")):
        with pytest.raises(pytest.fail.Exception, match="apart"):
            load_scene(tmp_path / root, CFG, tmp_path / run / "cache")


def test_folders_of_cameras_are_a_scene_with_an_option(tmp_path):
    names = ["front/0.png", "left/0.png"]
    for name in names:
        write_image(tmp_path / name, size=(8, 8))
    with refused("no scene in", "subfolders front, left", "--data.images ."):
        load_scene(tmp_path, CFG)
    found = find_scene(tmp_path, dataclasses.replace(CFG, images="."))
    assert isinstance(found, PhotographsAlone)
    assert [p.relative_to(found.folder).as_posix() for p in found.paths] == names


def test_masks_are_found_and_used(tmp_path):
    write_tiny_model(tmp_path, n=4)
    masks, names = tmp_path / "masks", ["im 0.png", "im 1.png.png", "im 2.png"]
    masks.mkdir()
    mask = np.full((30, 40), 255, np.uint8)
    mask[:, :10] = 0
    for name, image in zip(names, (mask, np.dstack([mask] * 3), mask[::2, ::2]), strict=True):
        cv2.imwrite(str(masks / name), image)
    scene = load_scene(tmp_path, CFG)
    assert [v.mask_path and v.mask_path.name for v in scene.views] == [*names, None]
    assert "1 of 4 views have no mask: im 3.png" in scene.notes[0]
    found = [ImageStore(scene.views, CFG).get(i)[1] for i in range(4)]
    for valid in found[:2]:
        assert np.array_equal(valid, (mask > 0).astype(np.float32))
    assert found[2][:, :10].max() == 0.0
    assert found[2][:, 12:].min() == found[3].min() == 1.0
    cv2.imwrite(str(masks / "im 3.png"), mask.T)
    with refused("wrong size: the mask .*im 3.png is 30x40"):
        store_of(tmp_path).get(3)


TIME, F_NUMBER, ISO, DATE = 33434, 33437, 34855, 36867
SHUTTER, APERTURE = 37377, 37378
FULL = {TIME: 0.01, F_NUMBER: 2.0, ISO: 400}


def jpeg_with_exif(path, tags):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("shots", "cameras", "expected"),
    [
        ([FULL, {**FULL, ISO: 800}], "aa", [0, 1]),
        # Settings that no photograph states drop out; the ISO value then counts as 100.
        ([{TIME: 0.01, F_NUMBER: 2.0}, {TIME: 0.02, F_NUMBER: 2.0}], "aa", [-2, -1]),
        ([{TIME: 0.01, ISO: 400}, {TIME: 0.02, ISO: 400}], "aa", [2, 3]),
        ([{F_NUMBER: 2.0, ISO: 400}, {F_NUMBER: 4.0, ISO: 400}], "aa", [6.644, 4.644]),
        # Settings that the same camera keeps constant drop out too, and no others.
        ([FULL, {TIME: 0.01, ISO: 400}, {TIME: 0.02, F_NUMBER: 2.0}], "aaa", [0, 0, 1]),
        ([FULL, {**FULL, ISO: 800}, {TIME: 0.01, F_NUMBER: 2.0}], "aaa", [0, 1, None]),
        ([FULL, {**FULL, ISO: 800}, {TIME: 0.01, ISO: 400}], "aab", [0, 1, None]),
        ([FULL, {**FULL, TIME: 0.0}, {F_NUMBER: 2.0}, {}], "aaaa", [0, 0, None, None]),
        # 1/128 s and f/4 in APEX; a lens without contacts writes zeros.
        (
            [{SHUTTER: 7.0, APERTURE: 4.0, ISO: 100}, {**FULL, TIME: 1 / 128}],
            "aa",
            [-4.356, -0.356],
        ),
        ([{**FULL, F_NUMBER: 0.0, APERTURE: 0.0}, {TIME: 0.02, ISO: 400}], "aa", [2, 3]),
    ],
)
def test_exposures_follow_from_incomplete_exif(tmp_path, shots, cameras, expected):
    paths = [jpeg_with_exif(tmp_path / f"{k}.jpg", tags) for k, tags in enumerate(shots)]
    found = exif_evs(paths, cameras)
    assert [ev if ev is None else pytest.approx(ev, abs=1e-3) for ev in expected] == found


def test_smaller_copies_have_the_exif_of_the_photographs(tmp_path):
    for folder in ("images/cam0", "images_2/cam0"):
        (tmp_path / folder).mkdir(parents=True)
    jpeg_with_exif(tmp_path / "images/cam0/a.jpg", FULL)
    jpeg_with_exif(tmp_path / "images/cam0/b.JPG", {**FULL, ISO: 800})
    (tmp_path / "images/cam0/b.DNG.xmp").touch()  # a sidecar
    copies = [tmp_path / "images_2/cam0" / name for name in ("a.jpg", "b.png", "c.png")]
    for path in copies:
        Image.new("RGB", (4, 4)).save(path)
    assert exif_evs(copies) == [pytest.approx(0), pytest.approx(1), None]


def test_settings_and_dates_of_exif_are_read(tmp_path):
    path, date = tmp_path / "a.jpg", "2010:10:12 14:43:07"
    shot = read_exif_settings(jpeg_with_exif(path, {**FULL, DATE: date}))
    assert shot == ExifSettings(pytest.approx(0.01), 2.0, 400.0, date)
    for tags in ({DATE: "    :  :     :  :  "}, {ISO: 65535, DATE: "yesterday"}):
        assert read_exif_settings(jpeg_with_exif(path, tags)) == ExifSettings()
    path.write_bytes(b"nothing")
    assert exif_evs([path, tmp_path / "absent.jpg"]) == [None, None]


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


@pytest.mark.parametrize(
    ("background", "color"),
    [("white", (1, 1, 1)), ("black", (0, 0, 0)), ("0.2,0.4,0.6", (0.2, 0.4, 0.6)),
     ("random", (1, 1, 1))],
)  # fmt: skip
def test_photographs_are_composited_over_the_background(cutouts, background, color):
    root, held = cutouts
    store = store_of(root, background=background)
    for k, rgba in enumerate(held):
        ldr, mask = store.get(k)
        alpha = rgba[..., 3:]
        assert np.allclose(ldr, alpha * rgba[..., :3] + (1 - alpha) * color, atol=2e-5)
        assert mask.min() == 1.0
    assert np.allclose(store.get(3)[0], 103 / 255)
    assert store.alpha(3).min() == 65535
    # Exposures and seeds see opaque pixels only.
    assert np.array_equal(store.only_opaque().get(1)[1], (held[1][..., 3] == 1).astype(np.float32))
    assert store.only_opaque().get(3)[1].min() == 1.0
    # Transparent pixels do not colour their neighbours.
    shrunk, premultiplied = store.get(0, 2)[0], held[0][..., :3] * held[0][..., 3:]
    premultiplied = premultiplied + (1 - held[0][..., 3:]) * color
    assert np.allclose(shrunk, premultiplied.reshape(15, 2, 20, 2, 3).mean((1, 3)), atol=2e-5)


def test_alpha_is_always_noted_and_remembered(cutouts, tmp_path_factory):
    for options, least, note in (
        ({}, None, "3 of 4 photographs have an alpha channel: photographs and renders are shown"),
        (
            {"background": "random"},
            None,
            "over a random colour at every step, and over white for scores",
        ),
        ({"alpha": "mask"}, 0.5, "transparent pixels are left out"),
        ({"alpha": "ignore"}, 0, "it is ignored"),
    ):
        scene = load_scene(cutouts[0], DataConfig(**options))
        assert note in scene.notes[-1]
        if least is not None:
            store = ImageStore(scene.views, DataConfig(**options))
            assert store.backdrop is store.alpha(0) is None
            ldr, mask = store.get(0)
            assert np.array_equal(mask, np.float32(cutouts[1][0][..., 3] >= least))
            assert np.allclose(ldr, cutouts[1][0][..., :3])
    run = tmp_path_factory.mktemp("run")
    write_scene(run, scene)
    again = read_scene(run, cutouts[0])
    assert [view.alpha for view in again.views] == [view.alpha for view in scene.views]
    assert again.split_by == scene.split_by
    folder = cutouts[0] / "images"
    (folder / "broken.png").write_bytes(b"\x89PNG")
    names = ("im 0.png", "im 3.png", "broken.png")
    assert [has_alpha(folder / name) for name in names] == [True, False, False]


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


@pytest.mark.parametrize("text", ["blue", "1,1", "0.5,0.5,1.5", "0,0,nan", "", "1,1,1,1"])
def test_invalid_colours_are_refused(text):
    with refused("is not a valid colour"):
        background_color(DataConfig(background=text))


def test_images_that_are_too_large_are_refused_by_their_header(tmp_path):
    write_tiny_model(tmp_path)
    bomb = bytearray((tmp_path / "images" / "im 1.png").read_bytes())
    bomb[16:24] = struct.pack(">II", 20_000, 20_000)
    bomb[29:33] = struct.pack(">I", zlib.crc32(bomb[12:29]))
    huge = r"im 1.png has more than 179 million pixels"
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "im 1.png").write_bytes(bomb)
    with refused(huge):
        store_of(tmp_path).get(1)
    (tmp_path / "images" / "im 1.png").write_bytes(bomb)
    # Sizes of photographs alone are checked before features are detected.
    for root in (tmp_path, tmp_path / "images"):
        with refused(huge):
            load_scene(root, CFG)
    with refused("cannot decode"):
        image_size(tmp_path / "images")


ALL = DataConfig(test_every=0)


@pytest.mark.parametrize(
    ("suffix", "kind"), [(".jfif", ".jpg"), (".jp2", ".jp2"), (".pgm", ".pgm")]
)
def test_rare_formats_are_read(tmp_path, suffix, kind):
    gray = np.tile(np.linspace(20, 230, 64, dtype=np.uint8), (48, 1))
    path = tmp_path / f"a{suffix}"
    path.write_bytes(cv2.imencode(kind, gray)[1].tobytes())
    assert list_images(tmp_path) == [path]
    pixels, mask = ImageStore((make_view(path),), CFG).get(0)
    np.testing.assert_allclose(pixels, np.repeat(gray[..., None] / 255.0, 3, -1), atol=4 / 255)
    assert mask.all()


def test_names_are_ordered_by_their_numbers(tmp_path):
    names = [f"frame_{k}.jpg" for k in range(1, 101)]
    assert sorted(sorted(names), key=natural) == names
    assert {(names[k], names[k + 1]) for k in range(99)} <= {*pairs_by_name(sorted(names))}
    views = tuple(dataclasses.replace(make_view(tmp_path / n), name=n) for n in sorted(names))
    held = [v.name for v in assign_split(views, 8) if v.split == "test"]
    assert sorted(held, key=natural) == names[::8]
    assert [v.name for v in sorted(views, key=time_order)] == names
    # A superscript digit is not a number.
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
    with pycolmap.Database.open(database) as db:
        assert {image.name for image in db.read_all_images()} == {*names}
        assert db.num_verified_image_pairs() == 2


MASKS = [
    *("masks/im 0.png", "masks/im 0.png.png", "masks/IM 0.PNG", "masks/im 0.jpg"),
    *("masks/im 0_mask.png", "masks/im 0.mask.png", "masks/mask_im 0.png", "mask/im 0.png"),
    *("images/masks/im 0.png", "images/im 0_mask.png", "images/dynamic_mask_im 0.png"),
    *("Masks/im 0.png", "dynamic_masks/im 0.png", "images/im 0.png.png"),
]


@pytest.mark.parametrize("place", MASKS)
def test_masks_are_found_under_names_of_other_programs(tmp_path, place):
    write_tiny_model(tmp_path)
    write_image(tmp_path / place, 0)
    scene = load_scene(tmp_path, ALL)
    assert [view.mask_path for view in scene.views] == [tmp_path / place, None]
    # A mask is not listed as a photograph.
    assert [p.name for p in list_images(tmp_path / "images")] == ["im 0.png", "im 1.png"]


def test_links_to_folders_are_followed_but_not_in_a_circle(tmp_path):
    for name in ("images/0.png", "disk/front/1.png", "more/2.png", "masked/1.jpg"):
        write_image(tmp_path / name)
    links = {"images/a": "disk", "images/b": "disk/front", "images/up": "images"}
    links |= {"disk/on": "more", "more/back": "disk", "masks/a/front": "masked"}
    (tmp_path / "masks" / "a").mkdir(parents=True)
    for link, target in links.items():
        (tmp_path / link).symlink_to(tmp_path / target)
    paths = list_images(tmp_path / "images")
    names = [path.relative_to(tmp_path / "images").as_posix() for path in paths]
    assert names == ["0.png", "a/front/1.png", "a/on/2.png", "b/1.png"]
    views = (dataclasses.replace(make_view(paths[1]), name=names[1]),)
    found, _ = attach_masks(Scene(tmp_path, "images", views, np.zeros((0, 3)), None))
    assert found[0].mask_path == tmp_path / "masks/a/front/1.jpg"


@pytest.mark.parametrize("name", ["front", "front/1.png"])
def test_folders_and_photographs_that_may_not_be_read_are_named(tmp_path, monkeypatch, name):
    for k in range(2):
        write_image(tmp_path / "images" / "front" / f"{k}.png")
    denied = tmp_path / "images" / name

    def as_for_others(function):  # tests run as root, who may read everything
        def call(path, *more, **options):
            if path == denied or path == str(denied):
                raise PermissionError(errno.EACCES, "Permission denied", str(path))
            return function(path, *more, **options)

        return call

    for module, function in ((os, "listdir"), (os, "scandir"), (io, "open"), (builtins, "open")):
        monkeypatch.setattr(module, function, as_for_others(getattr(module, function)))
    monkeypatch.setattr(np, "fromfile", as_for_others(np.fromfile))
    with pytest.raises(PermissionError) as error:
        [image_size(path) for path in list_images(tmp_path / "images")]
    assert error.value.filename == str(denied)


def test_masks_of_several_cameras_are_not_mixed_up(tmp_path):
    views = []
    for camera in ("a", "b"):
        write_image(tmp_path / "images" / camera / "0.jpg")
        write_image(tmp_path / "masks" / camera / "0_mask.png")
        # Names may be relative to the folder of the camera.
        views.append(make_view(tmp_path / "images" / camera / "0.jpg"))
    found, _ = attach_masks(Scene(tmp_path, "transforms", tuple(views), np.zeros((0, 3)), None))
    assert [v.mask_path.parent.name for v in found] == ["a", "b"]


def test_masks_of_no_photograph_are_noted_and_mask_may_be_part_of_a_name(tmp_path):
    write_tiny_model(tmp_path)
    write_image(tmp_path / "masks" / "other.png")
    (note,) = load_scene(tmp_path, ALL).notes
    assert note.endswith(
        "masks holds 1 files, but none has the name of a photograph: "
        "name each mask like its photograph"
    )
    # No photograph has this name without the word "mask".
    write_image(tmp_path / "images" / "venetian_mask.png")
    assert len(list_images(tmp_path / "images")) == 3


def test_alpha_matters_only_if_it_varies(tmp_path):
    write_tiny_model(tmp_path)

    def write(alpha):
        for k in range(2):
            pixels = np.full((30, 40, 4), (90, 90, 90, alpha), np.uint8)
            cv2.imwrite(str(tmp_path / "images" / f"im {k}.png"), pixels)

    write(255)
    scene = load_scene(tmp_path, ALL)
    assert ImageStore(scene.views, ALL).backdrop is None
    assert not any("alpha" in note or "--background" in note for note in scene.notes)
    scene = load_scene(tmp_path, DataConfig(background="black"))
    assert "--background black has no effect" in scene.notes[-1]
    write(0)
    with refused("im 0.png is transparent everywhere", "--data.alpha ignore"):
        load_scene(tmp_path, ALL)
    assert "ignored" in load_scene(tmp_path, DataConfig(alpha="ignore")).notes[-1]
    write_rgba(tmp_path / "images" / "im 1.png")
    assert ImageStore(load_scene(tmp_path, ALL).views, ALL).backdrop is not None


def test_photographs_are_decoded_together_as_far_as_memory_goes():
    room = Room(100)
    with room.reserving(60), room.reserving(40):
        assert room._reserved == 100
    with room.reserving(1000):  # a single photograph always has room
        assert room._reserved == 1000
    assert room._reserved == 0
