"""Features and matches stay where photographs are added, and go where one changed."""

import os
import shutil

import pycolmap
import pytest
from PIL import Image

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.cache import StageProgress
from p2gs_jax.scene.sfm import map as structure_from_motion
from p2gs_jax.scene.sfm.features import kept_features, match_kept, quiet_colmap
from p2gs_jax.scene.sfm.map import reasons, sentence


@pytest.fixture(scope="module")
def photographs(noisy_street):
    """Return some photographs of a street, those of one camera."""
    quiet_colmap()
    return sorted((noisy_street / "images").rglob("*.png"))[:5]


def filled(folder, photographs):
    folder.mkdir()
    for k, path in enumerate(photographs):
        shutil.copyfile(path, folder / f"{k}.png")
    return folder


def names_in(database):
    db = pycolmap.Database.open(database)
    try:
        return {i.name: (i.camera_id, i.image_id) for i in db.read_all_images()}
    finally:
        db.close()


def test_only_what_is_new_is_done(photographs, tmp_path):
    folder, said = filled(tmp_path / "photos", photographs), []
    names = [f"{k}.png" for k in range(5)]
    keep = tmp_path / "features"
    database = kept_features(keep, folder, {("one",): names[:3]}, said.append)
    assert match_kept(database, names[:3], None, said.append) == 3
    before = names_in(database)
    assert said == ["detecting features: 3 images", "matching: 3 image pairs"]

    said.clear()
    database = kept_features(keep, folder, {("one",): names}, said.append)
    assert match_kept(database, names, None, said.append) == 10
    after = names_in(database)
    assert {n: after[n] for n in before} == before
    assert len({camera for camera, _ in after.values()}) == 1, "still one camera"
    assert "features of 3 images are kept from an earlier run" in said
    assert "detecting features: 2 images" in said
    assert "matches of 3 image pairs are kept from an earlier run" in said
    assert "matching: 7 image pairs" in said

    said.clear()
    os.utime(folder / "1.png", ns=(1, 1))
    kept_features(keep, folder, {("one",): names}, said.append)
    assert said == ["detecting features: 5 images"], "one changed: all anew"

    said.clear()
    kept_features(keep, folder, {("one",): names[:3], ("two",): names[3:]}, said.append)
    assert said == ["detecting features: 5 images"], "other cameras: all anew"


def test_reasons(photographs, tmp_path):
    folder = filled(tmp_path / "photos", photographs[:2])
    Image.new("RGB", (192, 128), (90, 90, 90)).save(folder / "blank.png")
    names = ["0.png", "1.png", "blank.png"]
    database = kept_features(tmp_path / "f", folder, {("one",): names}, lambda text: None)
    match_kept(database, names, None, lambda text: None)
    why = reasons(database, names, [])
    assert set(why) == set(names)
    assert why["blank.png"].startswith("no features")
    assert why["0.png"] == why["1.png"] == "matches only photographs that did not register either"
    assert "0.png, 1.png (matches only" in sentence(why)


def test_pace_tells_what_is_left():
    now, said = [0.0], []
    pace = StageProgress(said.append, "matching", 100, "pairs", clock=lambda: now[0])
    for seconds, done in ((1, 5), (20, 25), (21, 26), (3600, 50), (3700, 100)):
        now[0] = seconds
        pace(done)
    assert said == [
        "matching: 100 pairs",
        "matching: 25 of 100 pairs, about 1:00 left at this pace",
        "matching: 50 of 100 pairs, about 1:00:00 left at this pace",
    ]
    said.clear()
    StageProgress(said.append, "matching", 0, "pairs")
    assert said == []


def test_a_mapper_that_is_not_there_is_named(monkeypatch, photographs, tmp_path):
    monkeypatch.delattr(structure_from_motion.pycolmap, "global_mapping")
    folder = filled(tmp_path / "photos", photographs[:2])
    with pytest.raises(UserError, match="no global mapper") as info:
        structure_from_motion.load_images(
            tmp_path, folder, sorted(folder.iterdir()), DataConfig(mapper="global"), None, print
        )
    assert "pycolmap" in info.value.fix
