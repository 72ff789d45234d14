"""What is exported for COLMAP and nerfstudio is the same scene, with its exposures."""

import csv
import dataclasses

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scene.convert.made import DISPLAY_P3, save_heic, write_exr
from tiny_scene import make_scene

from p2gs_jax.config import DataConfig
from p2gs_jax.core.numerics import srgb_decode
from p2gs_jax.export.folders import write_folder
from p2gs_jax.scene import ImageStore, load_scene
from p2gs_jax.scene.exposures import read_known_exposures

EXPOSURES = {"0.png": 0.5, "1.png": 2.0, "2.png": 1.25}


def rows(scene):
    """Return photometry of the views: one held out with a fitted exposure, one without."""
    out = []
    for v in scene.views:
        name = f"{v.name.partition('.')[0]}.png"
        e, test = EXPOSURES.get(name), name == "0.png"
        fitted = {"exposure": None if test else e, "exposure_fitted": e if test else None}
        common = {"image": v.name, "camera": v.camera, "split": "test" if test else "train"}
        out.append({**common, **fitted, "exposure_ev": None, "gamma": 2.2, "exif_ev": None})
    return out


def export(root, cfg, program="colmap"):
    scene = load_scene(root, cfg, root / "cache")
    store = ImageStore(scene.views, cfg)
    write_folder(program, root / "out", scene, store, rows(scene))
    return scene, store, load_scene(root / "out", DataConfig())


def named(root, suffix, write, folder=""):
    """Give the photographs of a scene another format; `write` gets a path and an image."""
    listed = root / "sparse" / "0" / "images.txt"
    text = listed.read_text()
    (root / "images" / folder).mkdir(exist_ok=True)
    for path in sorted((root / "images").glob("*.png")):
        target = root / "images" / folder / f"{path.stem}{suffix}"
        with Image.open(path) as image:
            write(target, image)
        if target != path:
            path.unlink()
        text = text.replace(path.name, f"{folder}{target.name}")
    listed.write_text(text)
    return root


def camera_with_distortion(root):
    """Give the scene an OPENCV camera, and photographs in JPEG with EXIF, in a folder."""
    path = root / "sparse" / "0" / "cameras.txt"
    _, _, *numbers = path.read_text().split()
    path.write_text(" ".join(["1", "OPENCV", *numbers, "0.08", "0.01", "0.001", "-0.002"]) + "\n")
    return named(root, ".jpg", in_adobe_rgb, "left/")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    root = tmp_path_factory.mktemp("plain")
    before, _, after = export(make_scene(root), DataConfig())
    return root / "out", before, after


def test_an_undistorted_scene_comes_back_as_it_was(exported):
    out, before, after = exported
    for a, b in zip(after.views, before.views, strict=True):
        assert (a.name, a.camera, a.split) == (b.name, b.camera, b.split)
        np.testing.assert_allclose(a.viewmat, b.viewmat, atol=1e-7)
        np.testing.assert_array_equal(a.K, b.K)
        assert (a.width, a.height, a.distortion) == (b.width, b.height, None)
        assert a.image_path.read_bytes() == b.image_path.read_bytes(), "used as they are"
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(after.point_colors, before.point_colors)
    for name in ("view_indices", "point_indices", "xy"):
        np.testing.assert_array_equal(getattr(after.tracks, name), getattr(before.tracks, name))
    assert not (out / "masks").exists()


def test_pycolmap_reads_the_model(exported):
    out, before, _ = exported
    model = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    assert model.num_reg_images() == 6
    assert {c.model.name for c in model.cameras.values()} == {"PINHOLE"}
    assert model.num_points3D() == len(before.points)
    assert model.compute_num_observations() == len(before.tracks.xy)
    written = {k: p.error for k, p in model.points3D.items()}
    model.update_point_3d_errors()
    # Observations travel as float32, and are moved a little to be told from zero.
    assert all(0 < e < 1e-3 for e in written.values())
    assert written == pytest.approx({k: p.error for k, p in model.points3D.items()}, abs=1e-9)
    assert model.compute_mean_reprojection_error() < 1e-3, "the dots lie where points project"


def test_exposures_are_what_known_exposures_reads(exported):
    out, _, after = exported
    found = read_known_exposures(str(out / "exposures.csv"), list(after.views))
    expected = [EXPOSURES.get(v.name, np.nan) for v in after.views]
    np.testing.assert_allclose(np.exp(found), expected, rtol=1e-12)
    with (out / "exposures.csv").open() as file:
        first = next(csv.DictReader(file))
    assert first["split"] == "test"
    assert float(first["ev"]) == -1.0


@pytest.mark.parametrize("program", ["colmap", "nerfstudio"])
def test_distorted_and_shrunk_photographs_become_pinhole_ones(tmp_path, program):
    root, cfg = camera_with_distortion(make_scene(tmp_path)), DataConfig(max_width=80, test_every=3)
    before, ours, after = export(root, cfg, program)
    theirs = ImageStore(after.views, DataConfig())
    for index, (a, b) in enumerate(zip(after.views, before.views, strict=True)):
        assert b.name.endswith(a.name)
        assert a.exif_ev == pytest.approx(b.exif_ev), "EXIF survives"
        viewmat, K, width, height = ours.camera(index)
        assert (a.width, a.height, a.distortion) == (width, height, None) == (80, 71, None)
        np.testing.assert_allclose(a.K, K, rtol=1e-6)
        np.testing.assert_allclose(a.viewmat, viewmat, atol=1e-6)
        (mine, mask), (other, mask_after) = ours.get(index), theirs.get(index)
        np.testing.assert_array_equal(mask_after, mask)
        assert 0 < mask.mean() < 1, "corners without a source are masked"
        assert np.abs(other - mine).mean() < 2 / 255
    np.testing.assert_allclose(after.points, before.points, atol=1e-6)
    np.testing.assert_array_equal(after.point_colors, before.point_colors)
    assert (root / "out" / "exposures.csv").is_file()
    if program == "colmap":
        assert [v.name for v in after.views] == [f"left/{v}.jpg" for v in range(6)]
        # Tracks are undistorted and shrunk along with the photographs.
        scale = np.array([80 / 112, 71 / 100])
        np.testing.assert_allclose(after.tracks.xy, before.tracks.xy * scale, rtol=1e-5)
    else:
        assert after.format == "transforms"
        assert [v.split for v in after.views] == [v.split for v in before.views]


def test_points_need_no_tracks(tmp_path):
    scene = load_scene(make_scene(tmp_path), DataConfig())
    bare = dataclasses.replace(scene, tracks=None)
    write_folder("colmap", tmp_path / "bare", bare, ImageStore(scene.views, DataConfig()), [])
    after = load_scene(tmp_path / "bare", DataConfig())
    np.testing.assert_array_equal(after.points, scene.points)
    assert after.tracks is None


def in_display_p3(path, image):
    image.save(path, icc_profile=DISPLAY_P3)


def in_adobe_rgb(path, image):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829A: 0.1, 0x829D: 4.0, 0x8827: 100, 0xA001: 0xFFFF})
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    image.save(path, exif=exif, quality=98)


def as_light(path, image):
    write_exr(path, srgb_decode(np.asarray(image) / 255).astype(np.float32))


FORMATS = [(".png", in_display_p3), (".jpg", in_adobe_rgb), (".exr", as_light)]
FORMATS += [(".heic", lambda path, image: save_heic(path, np.asarray(image)))]
FORMATS += [(".tif", lambda path, image: image.save(path))]
FORMATS += [(".PNG", lambda path, image: image.quantize(256).save(path))]


@pytest.mark.parametrize(("program", "width"), [("colmap", 80), ("nerfstudio", None)])
@pytest.mark.parametrize(("suffix", "write"), FORMATS, ids=[name for name, _ in FORMATS])
def test_every_format_is_read_back_with_its_colours(tmp_path, suffix, write, program, width):
    root = named(make_scene(tmp_path), suffix, write)
    _, ours, after = export(root, DataConfig(max_width=width), program)
    theirs = ImageStore(after.views, DataConfig())
    ending = suffix if suffix in (".png", ".PNG", ".jpg") else f"{suffix}.png"
    for index, view in enumerate(after.views):
        assert view.name.endswith(ending)
        with Image.open(view.image_path) as image:
            assert image.mode == "RGB"
        # JPEG twice; elsewhere what 8 bits round.
        limit = 2 / 255 if suffix == ".jpg" else 1 / 255
        assert np.abs(theirs.get(index)[0] - ours.get(index)[0]).mean() < limit
    if program == "colmap":
        # Exposures of names that photographs have.
        read_known_exposures(root / "out" / "exposures.csv", after.views[1:3])


@pytest.mark.parametrize("program", ["colmap", "nerfstudio"])
def test_masks_are_written_for_all_views_once_one_has_any(tmp_path, program):
    root = make_scene(tmp_path)
    (root / "masks").mkdir()
    half = np.full((100, 112), 255, np.uint8)
    half[:50] = 0
    Image.fromarray(half).save(root / "masks" / "2.png")
    _, store, after = export(root, DataConfig(), program)
    written = sorted(p.name for p in (root / "out" / "masks").iterdir())
    assert written == [f"{v}.png.png" for v in range(6)]
    again = ImageStore(after.views, DataConfig())
    for index in range(6):
        np.testing.assert_array_equal(again.get(index)[1], store.get(index)[1])
    assert again.get(2)[1].mean() == pytest.approx(0.5)


def test_a_failure_leaves_nothing_behind(tmp_path):
    root = make_scene(tmp_path)
    scene = load_scene(root, DataConfig())
    (root / "images" / "3.png").write_bytes(b"broken")
    for program in ("colmap", "nerfstudio"):
        store = ImageStore(scene.views, DataConfig())
        with pytest.raises(Exception, match=r"3\.png"):
            write_folder(program, root / "out", scene, store, rows(scene))
    assert sorted(p.name for p in root.iterdir()) == ["images", "sparse"]
