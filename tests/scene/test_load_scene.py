"""Detection of formats, masks, EXIF, splits."""

import csv
import dataclasses

import cv2
import numpy as np
import pytest
from PIL import Image
from scene.helpers import write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import ImageStore, PhotographsAlone, find_scene, load_scene
from p2gs_jax.scene.convert.headers import ExifSettings, read_exif_ev, read_exif_settings
from p2gs_jax.scene.split import assign_split
from p2gs_jax.types import View

CFG = DataConfig()


def test_nothing_there(tmp_path):
    with pytest.raises(UserError, match="no scene in") as info:
        load_scene(tmp_path, CFG)
    for expected in (str(tmp_path), "COLMAP", "transforms.json", "photographs", "images"):
        assert expected in str(info.value)
    with pytest.raises(UserError, match="does not exist"):
        load_scene(tmp_path / "nowhere", CFG)
    file = tmp_path / "notes.txt"
    file.write_bytes(b"")
    with pytest.raises(UserError, match=r"notes.txt is neither"):
        load_scene(file, CFG)


def test_a_folder_of_cameras_is_one_if_asked_for(tmp_path):
    for name in ("front/0.png", "left/0.png"):
        (tmp_path / name).parent.mkdir()
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(UserError, match="no scene in") as info:
        load_scene(tmp_path, CFG)
    assert "folder(s) front, left" in str(info.value.fix)
    assert "--data.images ." in str(info.value.fix)
    found = find_scene(tmp_path, dataclasses.replace(CFG, images="."))
    assert isinstance(found, PhotographsAlone)
    assert [p.relative_to(found.folder).as_posix() for p in found.paths] == [
        "front/0.png",
        "left/0.png",
    ]


def test_masks_are_found_and_used(tmp_path):
    write_tiny_model(tmp_path, n=4)
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.full((30, 40), 255, np.uint8)
    mask[:, :10] = 0
    cv2.imwrite(str(masks / "im 0.png"), mask)
    cv2.imwrite(str(masks / "im 1.png.png"), np.dstack([mask] * 3))
    cv2.imwrite(str(masks / "im 2.png"), mask[:, ::2][::2])
    scene = load_scene(tmp_path, CFG)
    assert [v.mask_path and v.mask_path.name for v in scene.views] == [
        "im 0.png",
        "im 1.png.png",
        "im 2.png",
        None,
    ]
    assert "1 of 4 views have no mask: im 3.png" in scene.notes[0]
    store = ImageStore(scene.views, CFG)
    for i in range(2):
        _, m = store.get(i)
        assert np.array_equal(m, (mask > 0).astype(np.float32))
    assert store.get(2)[1][:, :10].max() == 0.0
    assert store.get(2)[1][:, 12:].min() == 1.0
    assert store.get(3)[1].min() == 1.0
    cv2.imwrite(str(masks / "im 3.png"), mask.T)
    with pytest.raises(UserError, match="wrong size: the mask"):
        ImageStore(load_scene(tmp_path, CFG).views, CFG).get(3)


def test_exif_of_sceaux_agrees_with_its_table(shared_data):
    folder = shared_data("sceaux_castle")
    scene = load_scene(folder, CFG)
    with (folder / "exposures.csv").open() as file:
        truth = {row["file"]: float(row["rel_exposure_ev"]) for row in csv.DictReader(file)}
    ev = np.array([v.exif_ev for v in scene.views], float)
    expected = np.array([truth[v.name] for v in scene.views])
    assert np.allclose(ev - ev.mean(), expected - expected.mean(), atol=1e-3)


def _jpeg_with_exif(path, tags):
    image = Image.new("RGB", (8, 8))
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    image.save(path, exif=exif)
    return path


def test_exif_rules(tmp_path):
    full = {33434: 0.01, 33437: 2.0, 34855: 400}
    path = tmp_path / "a.jpg"
    assert read_exif_ev(_jpeg_with_exif(path, full)) == pytest.approx(0.0)
    no_iso = {k: full[k] for k in (33434, 33437)}
    assert read_exif_ev(_jpeg_with_exif(path, no_iso)) == pytest.approx(-2.0)
    for tag in (33434, 33437):
        rest = {k: v for k, v in full.items() if k != tag}
        assert read_exif_ev(_jpeg_with_exif(path, rest)) is None
    assert read_exif_ev(_jpeg_with_exif(path, {**full, 33434: 0.0})) is None
    data = bytearray(_jpeg_with_exif(path, full).read_bytes())
    rng = np.random.default_rng(0)
    for _ in range(50):
        broken = data.copy()
        at = data.find(b"Exif") + 6
        for i in rng.integers(at, at + 60, 8):
            broken[i] = rng.integers(256)
        path.write_bytes(broken)
        read_exif_ev(path)
    path.write_bytes(b"nothing")
    assert read_exif_ev(path) is None
    assert read_exif_ev(tmp_path / "absent.jpg") is None


def test_how_a_photograph_was_taken(tmp_path):
    path = tmp_path / "a.jpg"
    taken = {36867: "2010:10:12 14:43:07"}
    shot = read_exif_settings(_jpeg_with_exif(path, {33434: 0.01, 33437: 2.0, 34855: 400, **taken}))
    assert shot == ExifSettings(pytest.approx(0.01), 2.0, 400.0, "2010:10:12 14:43:07")
    assert (
        read_exif_settings(_jpeg_with_exif(path, {36867: "    :  :     :  :  "})) == ExifSettings()
    )
    assert (
        read_exif_settings(_jpeg_with_exif(path, {34855: 65535, 36867: "yesterday"}))
        == ExifSettings()
    )
    assert read_exif_settings(tmp_path / "absent.jpg") == ExifSettings()


def _view(name, camera):
    eye = np.eye(4, dtype=np.float32)
    return View(name, None, camera, eye, eye[:3, :3], 4, 3)  # type: ignore[arg-type]


def test_split_per_camera():
    views = [_view(f"l/{i:02d}", "l") for i in range(9)] + [_view(f"r/{i}", "r") for i in range(2)]
    views.append(_view("s", "single"))
    out = assign_split(tuple(reversed(views)), 4)
    test = {v.name for v in out if v.split == "test"}
    assert test == {"l/00", "l/04", "l/08", "r/0"}
    assert [v.name for v in out] == [v.name for v in reversed(views)]
    held_out = assign_split(tuple(views), 0)
    assert all(v.split == "train" for v in held_out)
    again = assign_split(tuple(dataclasses.replace(v, split="test") for v in views), 0)
    assert all(v.split == "train" for v in again)
    for n in (1, -2):
        with pytest.raises(UserError, match="hold out"):
            assign_split(tuple(views), n)
