"""Exports for other programs hold the same scene: poses, photographs, points and exposures."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from PIL import Image
from plyfile import PlyData
from scene.convert.made import DISPLAY_P3, save_heic, write_exr
from splats import random_splats
from tiny_scene import make_scene, noise_scene, rewrite

from p2gs_jax.config import DataConfig, FitConfig, PhotometryConfig, RenderConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.numerics import srgb_decode
from p2gs_jax.export.folders import write_folder
from p2gs_jax.export.sidecar import linear_sidecar
from p2gs_jax.formats.ply import write_radiance
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.response import FREE, KNOTS
from p2gs_jax.render.harmonics import evaluate, radiance_activation
from p2gs_jax.scene import ImageStore, load_scene
from p2gs_jax.scene.exposures import read_known_exposures

EXPOSURES = {"0.png": 0.5, "1.png": 2.0, "2.png": 1.25}


def rows(scene):
    """Return views of `photometry.json`: one is held out, some have no exposure."""
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
    # Other views than the reader would hold out by itself.
    views = [
        replace(v, split="test" if i in (2, 3) else "train") for i, v in enumerate(scene.views)
    ]
    scene = replace(scene, views=tuple(views))
    store = ImageStore(scene.views, cfg)
    write_folder(program, root / "out", scene, store, rows(scene))
    return scene, store, load_scene(root / "out", DataConfig())


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    root = tmp_path_factory.mktemp("plain")
    before, _, after = export(make_scene(root), DataConfig())
    return root / "out", before, after


def test_an_undistorted_scene_is_read_back_unchanged(exported):
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
    # Observations travel as float32, and are moved a little to differ from zero.
    assert all(0 < e < 1e-3 for e in written.values())
    assert written == pytest.approx({k: p.error for k, p in model.points3D.items()}, abs=1e-9)
    assert model.compute_mean_reprojection_error() < 1e-3, "the dots lie where points project"


@pytest.mark.parametrize("program", ["colmap", "nerfstudio"])
def test_distorted_and_shrunk_photographs_become_pinhole_photographs(tmp_path, program):
    root = rewrite(make_scene(tmp_path), ".jpg", in_adobe_rgb, "left/")
    path = root / "sparse" / "0" / "cameras.txt"
    lens = path.read_text().strip().replace("PINHOLE", "OPENCV")
    path.write_text(f"{lens} 0.08 0.01 0.001 -0.002\n")
    before, ours, after = export(root, DataConfig(max_width=80, test_every=3), program)
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


def in_adobe_rgb(path, image):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829A: 0.1, 0x829D: 4.0, 0x8827: 100, 0xA001: 0xFFFF})
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    image.save(path, exif=exif, quality=98)


def as_light(path, image):
    write_exr(path, srgb_decode(np.asarray(image) / 255).astype(np.float32))


FORMATS = [
    (".png", lambda path, image: image.save(path, icc_profile=DISPLAY_P3)),
    *((".jpg", in_adobe_rgb), (".exr", as_light)),
    (".heic", lambda path, image: save_heic(path, np.asarray(image))),
    (".tif", lambda path, image: image.save(path)),
    (".PNG", lambda path, image: image.quantize(256).save(path)),
]


@pytest.mark.parametrize(("program", "width"), [("colmap", 80), ("nerfstudio", None)])
@pytest.mark.parametrize(("suffix", "write"), FORMATS, ids=[name for name, _ in FORMATS])
def test_every_format_is_read_back_with_its_colours(tmp_path, suffix, write, program, width):
    root = rewrite(make_scene(tmp_path), suffix, write)
    _, ours, after = export(root, DataConfig(max_width=width), program)
    theirs = ImageStore(after.views, DataConfig())
    ending = suffix if suffix in (".png", ".PNG", ".jpg") else f"{suffix}.png"
    for index, view in enumerate(after.views):
        assert view.name.endswith(ending)
        with Image.open(view.image_path) as image:
            assert image.mode == "RGB"
        # JPEG is compressed twice; other formats are rounded to 8 bits.
        limit = 2 / 255 if suffix == ".jpg" else 1 / 255
        assert np.abs(theirs.get(index)[0] - ours.get(index)[0]).mean() < limit
    if program == "colmap":
        # The table has the names of the photographs.
        read_known_exposures(root / "out" / "exposures.csv", after.views[1:3])


@pytest.mark.parametrize("width", [56, None])
def test_photographs_with_alpha_keep_it(tmp_path, width):
    """Over the backdrop they would show a white wall behind every object."""
    alpha = np.zeros((100, 112), np.uint8)
    alpha[20:80, 20:90] = 255

    def write(path, image):
        image.putalpha(Image.fromarray(alpha))
        image.save(path)

    _, ours, after = export(
        rewrite(make_scene(tmp_path), ".png", write), DataConfig(max_width=width)
    )
    theirs = ImageStore(after.views, DataConfig())
    for index in range(6):
        np.testing.assert_allclose(theirs.get(index)[0], ours.get(index)[0], atol=2 / 255)
        found = theirs.alpha(index) / np.iinfo(theirs.alpha(index).dtype).max
        wanted = ours.alpha(index) / np.iinfo(ours.alpha(index).dtype).max
        np.testing.assert_allclose(found, wanted, atol=1 / 255)
        assert found.min() == 0


def test_other_programs_turn_no_photograph(tmp_path):
    """Their readers obey the orientation in EXIF, which our poses and theirs do not."""
    exif = Image.Exif()
    exif[0x0112] = 6
    root = rewrite(make_scene(tmp_path), ".jpg", lambda path, image: image.save(path, exif=exif))
    export(root, DataConfig())
    with Image.open(root / "out" / "images" / "0.jpg") as image:
        assert image.size == (112, 100)
        assert 0x0112 not in image.getexif()


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


ROW = {"camera": "0", "exif_ev": None}
VIEWS = [
    {"image": "a.png", "exposure": 2.0, "exposure_ev": 1.0, "gamma": 2.4, "split": "train"},
    {"image": "b.png", "exposure": None, "exposure_ev": None, "gamma": None, "split": "test"},
]
SPLINE = tuple(np.where(np.isin(np.arange(len(KNOTS)), FREE), 0.05, 0.0))


def sidecar(folder, *, activation="exp", degree=3, **photometry):
    """Write both files; return the JSON as read and the Gaussians."""
    g = random_splats(degree=degree)
    scene, tone = noise_scene(folder, ("a.png",), ("b.png",)), PhotometryConfig(**photometry)
    cfg = FitConfig(render=RenderConfig(radiance=activation), photometry=tone)
    known = {
        "model": "view_exposure_gamma",
        "curve": {"name": tone.curve, "pivot": tone.pivot, "spline": None},
        "gauge": "in words",
        "mean": {"exposure": 2.0, "exposure_geometric": 2.0, "gamma": 2.4},
        "views": [{**ROW, **v, "exposure_fitted": 1.5} for v in VIEWS],
    }
    store = ImageStore(scene.views, DataConfig(max_width=20))
    write_json(folder / "linear.json", linear_sidecar(g, cfg, scene, store, known))
    write_radiance(folder / "linear.ply", g, activation=activation)
    return json.loads((folder / "linear.json").read_text()), g, cfg


@pytest.mark.parametrize("activation", ["exp", "linear"])
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_radiance_follows_from_the_two_files(tmp_path, activation, degree):
    saved, g, _ = sidecar(tmp_path, activation=activation, degree=degree)
    vertex = PlyData.read(str(tmp_path / saved["ply"]))["vertex"]
    x, y, z = direction = (0.36, 0.48, -0.8)
    K = saved["spherical_harmonics"]["coefficients"]
    assert K == (saved["spherical_harmonics"]["degree"] + 1) ** 2 == (degree + 1) ** 2
    basis = [eval(text, {"x": x, "y": y, "z": z}) for text in saved["spherical_harmonics"]["basis"]]
    radiance = np.empty((saved["gaussians"], 3))
    for c in range(3):
        names = [f"f_dc_{c}", *(f"f_rest_{c * (K - 1) + k - 1}" for k in range(1, K))]
        s = sum(b * vertex[name] for b, name in zip(basis, names, strict=True))
        formula = saved["radiance"]["formula"].split(" of the sum")[0]
        names = {"exp": np.exp, "log": np.log, "clip": np.clip, "max": np.maximum, "s": s}
        radiance[:, c] = eval(formula.removeprefix("L = "), names)
    ours = radiance_activation(
        evaluate(g.sh, tuple(jnp.full(50, v) for v in direction)), saved["radiance"]["activation"]
    )
    np.testing.assert_allclose(radiance, ours, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [{}, {"curve": "power", "pivot": 1.0, "clamp": True}, {"curve": "spline", "spline": SPLINE}],
)
@pytest.mark.parametrize(("exposure", "gamma"), [(1.0, 2.2), (2.5, 1.9), (0.2, 2.6)])
def test_the_tone_curve_follows_from_the_table(tmp_path, options, exposure, gamma):
    saved, _, cfg = sidecar(tmp_path, **options)
    tone = saved["tone"]
    radiance = np.exp2(np.linspace(-10, 3, 200)).astype(np.float32)
    exposed = np.maximum(exposure * radiance, tone["exposed_limits"][0])
    if tone["exposed_limits"][1] is not None:
        exposed = np.minimum(exposed, tone["exposed_limits"][1])
    linear = tone["pivot"] * (exposed / tone["pivot"]) ** (2.2 / gamma)
    found = np.interp(np.log(linear), np.log(tone["base"]["linear"]), tone["base"]["display"])
    expected = develop(radiance, DisplayTransform(exposure, gamma, cfg.photometry))
    np.testing.assert_allclose(found, expected, atol=0.5 / 255)


def test_views_have_cameras_at_the_size_of_the_fit_and_their_exposures(tmp_path):
    saved, _, _ = sidecar(tmp_path)
    a, b = saved["views"]
    assert (a["image"], a["exposure"], a["gamma"]) == ("a.png", 2.0, 2.4)
    assert (b["exposure"], b["exposure_fitted"]) == (None, 1.5)
    assert (a["width"], a["height"]) == (20, 17)
    assert a["K"] == [[20, 0, 10], [0, 20, 8.5], [0, 0, 1]]
    assert saved["mean"]["exposure_geometric"] == 2.0
    assert saved["tone"]["correction"] is None
    saved, *_ = sidecar(tmp_path, appearance="affine")
    assert saved["tone"]["correction"] == {"kind": "affine", "file": "linear.appearance.npy"}
