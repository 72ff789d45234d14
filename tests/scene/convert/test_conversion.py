"""HEIC, raw and linear photographs and colour profiles, from the file to the store's pixels."""

import dataclasses
import io
import json
import struct
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageCms, features
from PIL.PngImagePlugin import PngInfo
from scene.convert import made
from scene.helpers import make_view, refused, write_image, write_tiny_model

from p2gs_jax.config import DataConfig, FitConfig
from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.photometry.calibrate import options_of
from p2gs_jax.run.scene_file import read_scene, write_scene
from p2gs_jax.scene import ImageStore, load_scene
from p2gs_jax.scene.convert import icc
from p2gs_jax.scene.convert.convert import Converted, convert_photographs, with_originals
from p2gs_jax.scene.convert.icc import adobe_rgb, colour_notes, profile_of, read_profile, to_srgb
from p2gs_jax.scene.convert.readers import exif_evs, exif_of_raw, read_exif_settings
from p2gs_jax.scene.files import image_size, list_images
from p2gs_jax.scene.survey import survey
from p2gs_jax.types import Scene

CFG = DataConfig(test_every=0)
LIGHT = np.full((30, 40, 3), (0.1, 0.3, 0.5), np.float32)
GREY = np.full((64, 96, 3), 0.3)


def converted(folder: Path) -> Converted:
    work = folder.parent / "work"
    return convert_photographs(folder, list_images(folder), work, lambda message: None)


def stored(path: Path) -> np.ndarray:
    codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return codes[..., [2, 1, 0, 3][: codes.shape[2]]]


def light_of(path: Path) -> np.ndarray:
    codes = stored(path)[..., :3]
    assert codes.dtype == np.uint16
    return srgb_decode(codes / 65535)


def records_of(result: Converted) -> list[dict]:
    return json.loads((result.folder / "photographs.json").read_text())["photographs"]


def noted(result: Converted, words: str) -> bool:
    return any(words in note for note in result.notes)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    return tmp_path / "photos"


def test_raw_photographs_are_linear_above_their_black_level(folder: Path) -> None:
    light = 0.02 + 0.8 * made.patches() ** 2
    made.write_dng(folder / "a.dng", light, orientation=6)
    made.write_dng(folder / "b.dng", light / 4, orientation=1)
    made.write_dng(folder / "c.dng", np.full((64, 96, 3), 3.0))
    result = converted(folder)
    assert result.known == "camera raw"
    bright, dark, white = (light_of(path) for path in result.paths)
    assert bright.shape == (64, 96, 3)  # the sensor's orientation, not that of EXIF
    inner = (slice(8, -8), slice(8, -8))
    # The remaining error comes from LibRaw's interpolation between pixels of one colour.
    assert np.percentile(np.abs(bright - light)[inner], 99) < 0.02
    # Two stops are a factor of 4 in the dark, too: black was subtracted, nothing brightened.
    ratio = bright[inner] / dark[inner]
    assert np.median(ratio) == pytest.approx(4, rel=2e-3)
    assert np.percentile(np.abs(ratio - 4), 95) < 0.1
    # The sensor's white is saturated in all channels.
    assert white.min() == pytest.approx(1, abs=1e-4)
    assert records_of(result)[2]["saturated"] == 1


def test_all_raw_photographs_of_a_camera_get_one_white_balance(folder: Path) -> None:
    # Light and sensor stay the same; only the camera's white balance changes.
    light = np.full((64, 96, 3), (0.2, 0.3, 0.25))
    for name, chosen in {"a": (2.0, 1, 1.5), "b": (2.2, 1, 1.4), "c": (1.6, 1, 1.8)}.items():
        made.write_dng(folder / f"{name}.dng", light, chosen=chosen)
    result = converted(folder)
    colours = [light_of(path)[32, 48] for path in result.paths]
    np.testing.assert_allclose(colours, np.broadcast_to((0.2, 0.3, 0.25), (3, 3)), atol=2e-3)
    assert records_of(result)[1]["balance"] == pytest.approx((2.2, 1, 1.4), rel=1e-3)
    (note,) = (note for note in result.notes if note.startswith("White balance of 3"))
    assert "red 2.000, blue 1.500" in note


@pytest.mark.parametrize(
    ("module", "name", "package"),
    [("rawpy", "a.dng", "p2gs-jax[raw]"), ("pillow_heif", "a.heic", "p2gs-jax[heic]")],
)
def test_missing_packages_are_named(folder: Path, monkeypatch, module, name, package) -> None:
    (folder / name).write_bytes(b"whatever")
    monkeypatch.setitem(sys.modules, module, None)
    with refused(name, f"pip install '{package}'"):
        converted(folder)


def test_raw_beside_jpeg_is_one_photograph(folder: Path, monkeypatch) -> None:
    made.write_dng(folder / "a.dng", GREY, time=(1, 250), iso=400)
    write_image(folder / "a.jpg", 90, (96, 64))
    result = converted(folder)
    assert list(result.originals.values()) == [folder / "a.dng"]
    assert noted(result, "1 file will not be read (a.jpg, ...), because the same photograph")
    # The raw file's EXIF reaches the converted file.
    for file in (folder / "a.dng", *result.paths):
        assert exif_evs([file])[0] == pytest.approx(np.log2(1 / 250 * 400 / 2.8**2), abs=1e-3)
    assert read_exif_settings(result.paths[0]).time == pytest.approx(1 / 250)
    assert image_size(folder / "a.dng") == (96, 64)
    # Without rawpy the JPEG is used, without conversion.
    monkeypatch.setattr("p2gs_jax.scene.convert.convert.find_spec", lambda name: None)
    result = converted(folder)
    assert list(result.originals.values()) == result.paths == [folder / "a.jpg"]
    assert (result.folder, result.known) == (folder, None)


def save(path: Path, pixels: np.ndarray, **options) -> None:
    if path.suffix == ".heic":
        made.save_heic(path, pixels, **options)
        return
    if not features.check(path.suffix[1:]):
        pytest.skip(f"this Pillow does not support {path.suffix}")
    how = {"quality": 100, "subsampling": "4:4:4"} if path.suffix == ".avif" else {"lossless": True}
    Image.fromarray(pixels).save(path, **how, **options)


@pytest.mark.parametrize("kind", ["heic", "avif", "webp"])
def test_display_values_profile_and_settings_are_kept(folder: Path, kind: str) -> None:
    pixels, file = (40 + 150 * made.patches()).astype(np.uint8), folder / f"a.{kind}"
    save(file, pixels, exif=made.settings().tobytes(), icc_profile=made.DISPLAY_P3)
    assert image_size(file) == (96, 64)
    result = converted(folder)
    assert result.known is None  # the tone curve of a phone is unknown
    (path,) = result.paths
    assert stored(path).dtype == np.uint8
    assert np.abs(stored(path).astype(int) - pixels).max() <= 4
    with Image.open(path) as image:
        assert image.info["icc_profile"] == made.DISPLAY_P3
    for one in (path, file):
        assert exif_evs([one])[0] == pytest.approx(np.log2(200 / 60 / 2.8**2), abs=1e-3)
    file.write_bytes(file.read_bytes()[: 300 if kind == "avif" else -60])
    with refused(rf"a\.{kind} cannot be decoded"):
        converted(folder)


def test_a_jpeg_that_is_named_heic_is_read(folder: Path) -> None:
    Image.new("RGB", (40, 32)).save(folder / "a.heic", "jpeg")
    assert stored(converted(folder).paths[0]).shape == (32, 40, 3)


def test_ten_bit_heic_keeps_its_precision(folder: Path) -> None:
    ramp = np.linspace(20_000, 22_000, 96).astype(np.uint16)
    made.save_heic(folder / "a.heic", np.broadcast_to(ramp[None, :, None], (64, 96, 3)))
    codes = stored(converted(folder).paths[0])
    assert codes.dtype == np.uint16
    assert len(np.unique(codes[32, :, 1])) > 25  # 8 bits have 8 levels here


@pytest.mark.parametrize("deep", [False, True], ids=["8 bits", "10 bits"])
def test_white_is_white_and_coded_primaries_are_brought_to_srgb(folder: Path, deep: bool) -> None:
    top, kind = (65535, np.uint16) if deep else (255, np.uint8)
    for name, colour in {"green": (60, 200, 60), "white": (255, 255, 255)}.items():
        pixels = np.full((64, 96, 3), np.array(colour) * (top // 255), kind)
        # Display P3 by code points, without an ICC profile.
        coded = {"color_primaries": 12, "transfer_characteristics": 13, "matrix_coefficients": 6}
        made.save_heic(folder / f"{name}.heic", pixels, full_range_flag=1, **coded)
    green, white = (stored(path)[32, 48] / 257 for path in converted(folder).paths)
    np.testing.assert_allclose(green, (0, 203, 11), atol=3)
    np.testing.assert_allclose(white, 255, atol=0.01)


@pytest.mark.parametrize(("transfer", "light"), [(16, 0.0938), (18, 0.0840)], ids=["PQ", "HLG"])
def test_an_avif_coded_in_hlg_or_pq_is_light(folder: Path, transfer: int, light: float) -> None:
    save(folder / "a.avif", np.full((64, 96, 3), 128, np.uint8))
    before, mark, after = (folder / "a.avif").read_bytes().partition(b"colrnclx")
    coded = before + mark + bytes([0, 1, 0, transfer]) + after[4:]
    (folder / "a.avif").write_bytes(coded)
    result = converted(folder)
    assert result.known == "AVIF"
    np.testing.assert_allclose(light_of(result.paths[0]), light, rtol=0.01)


def tiff(tags: dict) -> bytes:
    exif = Image.Exif()
    exif.update(tags)
    return exif.tobytes()[6:]


def embedded(kind: str) -> bytes:
    """Return the beginning of a raw file that is not a plain TIFF."""
    camera, shot = tiff({0x010F: "Made", 0x0110: "One"}), tiff({0x829A: 0.5, 0x829D: 2.0})
    if kind == "cr3":
        boxes = ((b"CMT1", camera), (b"CMT2", shot))
        packed = b"".join((len(d) + 8).to_bytes(4, "big") + n + d for n, d in boxes)
        return b"\0\0\0\x18ftypcrx \0\0\0\1crx isom" + packed
    if kind == "raf":
        data = io.BytesIO()
        exif = Image.Exif()
        exif.load(b"Exif\0\0" + camera)
        Image.new("RGB", (8, 8)).save(data, "JPEG", exif=exif)
        head = b"FUJIFILMCCD-RAW 0201".ljust(84, b"\0") + (160).to_bytes(4, "big")
        return head.ljust(160, b"\0") + data.getvalue()
    mark = {"rw2": b"U\0", "orf": b"RO"}[kind]
    return camera[:2] + (mark if camera[:2] == b"II" else mark[::-1]) + camera[4:]


@pytest.mark.parametrize("kind", ["cr3", "raf", "rw2", "orf"])
def test_cameras_are_named_in_raw_files_of_every_maker(kind: str) -> None:
    exif = exif_of_raw(io.BytesIO(embedded(kind)))
    assert (exif[0x010F], exif[0x0110]) == ("Made", "One")
    if kind == "cr3":
        assert exif.get_ifd(0x8769)[0x829D] == 2.0


def test_exr_keeps_light_between_photographs(folder: Path) -> None:
    light = (0.001 + 6 * made.patches() ** 3).astype(np.float32)
    made.write_exr(folder / "a.exr", light)
    made.write_exr(folder / "b.exr", light / 8)
    assert image_size(folder / "a.exr") == (96, 64)
    result = converted(folder)
    assert result.known == "linear EXR"
    assert [r["scale"] for r in records_of(result)] == [0.125, 0.125]
    bright, dark = (light_of(path) for path in result.paths)
    np.testing.assert_allclose(bright, np.minimum(light * 0.125, 1), atol=1e-4)
    seen = dark > 1e-3
    assert np.median(bright[seen] / dark[seen]) == pytest.approx(8, rel=5e-3)
    assert noted(result, "multiplied by 0.125")


def test_nan_alpha_and_chromaticities_of_exr_are_converted(folder: Path) -> None:
    grey = np.full((8, 8, 1), 0.3, np.float32)
    grey[0, 0], grey[0, 1], grey[0, 2] = np.nan, np.inf, -1
    made.write_exr(folder / "a.exr", grey, "Y", expTime=0.01, aperture=4.0, isoSpeed=100.0)
    clear = np.full((8, 8, 4), 0.5, np.float32) * (0.6, 0.6, 0.6, 1)
    made.write_exr(folder / "b.exr", clear.astype(np.float32), "RGBA")
    p3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)
    green = np.broadcast_to(np.array([0, 0.5, 0], np.float32), (8, 8, 3))
    made.write_exr(folder / "c.exr", green, chromaticities=p3)
    result = converted(folder)
    a, b, c = result.paths
    assert light_of(a)[4, 4] == pytest.approx(0.3, abs=1e-4)
    assert noted(result, "1 pixels of linear photographs are not numbers")
    np.testing.assert_array_equal(light_of(a)[0, :3], [[0] * 3, [1] * 3, [0] * 3])
    assert exif_evs([a])[0] == pytest.approx(np.log2(0.01 * 100 / 16), abs=1e-3)
    assert stored(b).shape[2] == 4
    assert light_of(b)[4, 4] == pytest.approx(0.6, abs=1e-3)
    assert stored(b)[4, 4, 3] / 65535 == pytest.approx(0.5, abs=1e-3)
    assert light_of(c)[4, 4] == pytest.approx((0, 0.521, 0), abs=2e-3)


def test_infinite_and_transparent_light_of_exr_is_not_the_brightest(folder: Path) -> None:
    light = np.full((32, 32, 4), 0.5, np.float32)
    light[..., 3] = 1
    light[:4, :4, :3] = np.inf
    light[8:12, :4] = (0.5, 0.5, 0.5, 0)  # a glow
    rec2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.329)
    made.write_exr(folder / "a.exr", light, "RGBA")
    odd = {"expTime": "1/50", "isoSpeed": float("nan")}  # values that are not numbers do not count
    made.write_exr(folder / "b.exr", light, "RGBA", chromaticities=rec2020, **odd)
    for path in converted(folder).paths:
        assert light_of(path)[20, 20] == pytest.approx(0.5, abs=1e-3)
        assert (light_of(path)[:4, :4] == 1).all()
        assert (light_of(path)[8:12, :4] == 0).all()


def write_channels(path: Path, channels: dict[str, np.ndarray]) -> None:
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))


def test_the_picture_is_read_among_the_layers_of_an_exr(folder: Path) -> None:
    values = {"ViewLayer.AO": 0.9, "ViewLayer.Combined": 0.3}
    both = {f"{k}.{c}": np.full((8, 8), v, np.float32) for k, v in values.items() for c in "RGB"}
    write_channels(folder / "a.exr", both)
    assert light_of(converted(folder).paths[0])[4, 4] == pytest.approx(0.3, abs=1e-4)


def test_unsupported_and_broken_files_are_refused(folder: Path) -> None:
    def refuse(name: str, *words: str) -> None:
        with refused(*words):
            converted(folder)
        (folder / name).unlink()

    (folder / "a.nef").write_bytes(b"II*\0" + bytes(range(256)) * 40)
    refuse("a.nef", r"does not support .*a\.nef", "DNG Converter")
    made.write_exr(folder / "a.exr", np.ones((8, 8, 3), np.float32), pixelAspectRatio=2.0)
    refuse("a.exr", "pixels with the aspect ratio 2", "resample it")
    (folder / "a.exr").write_bytes(b"\x76\x2f\x31\x01 and nothing")
    refuse("a.exr", r"a\.exr is not a readable OpenEXR")
    made.write_exr(folder / "b.exr", np.ones((8, 8, 1), np.float32), "Z")
    refuse("b.exr", "has the channels Z")
    part = np.ones((8, 8), np.float32)
    write_channels(folder / "c.exr", {f"{k}.{c}": part for k in ("albedo", "ao") for c in "RGB"})
    refuse("c.exr", "has the layers albedo, ao", "save it with one layer")
    frame = (np.array([0, 0], np.int32), np.array([15, 15], np.int32))
    made.write_exr(folder / "d.exr", np.ones((8, 8, 3), np.float32), displayWindow=frame)
    refuse("d.exr", "has 8x8 pixels at .* in a frame of 16x16", "without a crop")
    made.save_heic(folder / "a.heic", np.full((64, 64, 3), 90, np.uint8))
    (folder / "a.heic").write_bytes((folder / "a.heic").read_bytes()[:-9])
    refuse("a.heic", r"a\.heic cannot be decoded: .*[^.\s]\.\n", "copy that photograph again")
    made.write_dng(folder / "a.dng", GREY)
    data = (folder / "a.dng").read_bytes()
    (folder / "a.dng").write_bytes(data[: len(data) // 2])
    refuse("a.dng", r"a\.dng")


def test_a_folder_of_several_formats_is_converted_once(folder: Path) -> None:
    (folder / "sub").mkdir()
    made.write_dng(folder / "sub" / "a.dng", GREY)
    write_image(folder / "b.jpg", 90, (96, 64))
    result = converted(folder)
    assert [p.relative_to(result.folder).as_posix() for p in result.paths] == ["b.jpg", "sub/a.png"]
    assert (result.folder / "b.jpg").read_bytes() == (folder / "b.jpg").read_bytes()
    assert result.known is None
    assert noted(result, "of several kinds (1 ")
    before = result.paths[1].stat().st_mtime_ns
    assert converted(folder).paths[1].stat().st_mtime_ns == before
    made.write_dng(folder / "sub" / "a.dng", 2 * GREY)
    assert light_of(converted(folder).paths[1])[32, 48, 1] == pytest.approx(0.6, abs=5e-3)


def test_a_colmap_model_of_exr_photographs_is_read(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    model = write_tiny_model(root) / "images.txt"
    model.write_text(model.read_text().replace(".png", ".exr"))
    for path in (root / "images").iterdir():
        path.unlink()
    (root / "masks").mkdir()
    for k in range(2):
        made.write_exr(root / "images" / f"im {k}.exr", LIGHT / (1 + k), expTime=0.01, aperture=2.0)
        cv2.imwrite(str(root / "masks" / f"im {k}.png"), np.eye(30, 40, dtype=np.uint8) * 255)
    assert survey(root, CFG).photographs == 2
    scene = load_scene(root, CFG, tmp_path / "work")
    assert [view.name for view in scene.views] == ["im 0.exr", "im 1.exr"]
    assert scene.known_response == "linear EXR"
    assert scene.views[0].exif_ev == pytest.approx(np.log2(0.01 * 100 / 4))
    store = ImageStore(scene.views, CFG)
    pixels, mask = store.get(1)
    assert store.stored(1)[0].dtype == np.uint16
    np.testing.assert_allclose(pixels, srgb_encode(LIGHT / 2), atol=2e-5)
    np.testing.assert_array_equal(mask, np.eye(30, 40))
    assert options_of(FitConfig(), scene).known_response == "linear EXR"
    # The run folder records the known response.
    (tmp_path / "run").mkdir()
    write_scene(tmp_path / "run", scene)
    again = read_scene(tmp_path / "run", root)
    assert again is not None
    assert again.known_response == "linear EXR"
    assert again.views[0].image_path == scene.views[0].image_path


def test_views_keep_the_names_and_masks_of_the_originals(tmp_path: Path) -> None:
    """Structure from motion reads converted files, whose names the scene must not show."""
    root = tmp_path / "scene"
    folder, masks = root / "images", [root / "masks" / name for name in ("a.png", "b.png")]
    write_image(folder / "a.jpg", 90, (96, 64))
    made.write_dng(folder / "b.dng", GREY)
    for mask in masks:
        write_image(mask, 255, (96, 64))
    paths = [folder / "a.jpg", folder / "b.dng"]
    photographs = convert_photographs(folder, paths, tmp_path / "work", lambda message: None)
    views = tuple(make_view(path, size=(96, 64)) for path in photographs.paths)
    found = Scene(photographs.folder, "images", views, np.zeros((0, 3), np.float32), None)
    scene = with_originals(found, photographs)
    assert [view.name for view in scene.views] == ["a.jpg", "b.dng"]
    files = [view.image_path for view in scene.views]
    assert files == [folder / "a.jpg", photographs.folder / "b.png"]
    assert [view.mask_path for view in scene.views] == masks
    assert scene.known_response is None
    raw = survey(folder, dataclasses.replace(CFG, images=".")).cameras[0]
    assert raw.size == (96, 64)
    assert raw.ev is not None


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
TABLES = made.DISPLAY_P3.replace(b"rXYZ", b"A2B0")
PIXELS = (40 + 150 * made.patches()).astype(np.uint8)


@pytest.mark.parametrize(
    ("data", "name"), [(made.DISPLAY_P3, "Display P3"), (made.ADOBE_RGB, "Adobe RGB")]
)
def test_converted_colours_agree_with_littlecms(data: bytes, name: str) -> None:
    profile = read_profile(data)
    assert profile is not None
    assert profile.name.startswith(name)
    source, target = ImageCms.ImageCmsProfile(io.BytesIO(data)), ImageCms.createProfile("sRGB")
    how = ImageCms.Intent.RELATIVE_COLORIMETRIC
    image = ImageCms.profileToProfile(Image.fromarray(PIXELS), source, target, how)
    theirs = np.asarray(image, float)
    inside = (theirs > 0) & (theirs < 255)
    assert inside.mean() > 0.9
    assert np.abs(to_srgb(PIXELS, profile) / 257 - theirs)[inside].max() < 1.5
    # The conversion changes colours; otherwise the comparison above would prove nothing.
    assert np.abs(theirs - PIXELS).max() > 10
    # Grey stays grey.
    grey = np.repeat(np.array([[30, 128, 255]], np.uint8)[..., None], 3, 2)
    out = to_srgb(grey, profile).astype(float)
    assert np.ptp(out, axis=2).max() < 0.004 * 65535
    assert out[0, 2].min() > 0.998 * 65535


def test_srgb_and_broken_profiles_change_nothing() -> None:
    for data in (SRGB, b"", made.DISPLAY_P3[:200]):
        assert read_profile(data) is None


def test_a_store_converts_colours_and_notes_say_so(tmp_path: Path) -> None:
    profiles = {"a.png": None, "b.png": made.DISPLAY_P3, "c.png": TABLES}
    views = [make_view(tmp_path / name, size=(96, 64)) for name in profiles]
    for view, data in zip(views, profiles.values(), strict=True):
        Image.fromarray(PIXELS).save(view.image_path, **({"icc_profile": data} if data else {}))
    kept, changed, tabulated = (ImageStore(views, DataConfig()).stored(k)[0] for k in range(3))
    assert kept.dtype == np.uint8  # photographs without conversion stay 8-bit
    assert changed.dtype == np.uint16
    profile = read_profile(made.DISPLAY_P3)
    assert profile is not None
    np.testing.assert_array_equal(changed, to_srgb(PIXELS, profile))
    np.testing.assert_array_equal(tabulated, PIXELS)
    notes = colour_notes(view.image_path for view in views)
    assert notes[0] == "1 photographs are in Display P3; they are converted to sRGB."
    assert "not applied" in notes[1]


def test_alpha_beside_a_profile_is_kept_and_grey_is_unchanged(tmp_path: Path) -> None:
    pixels = np.full((8, 8, 4), 100, np.uint8)
    pixels[:, :4, 3], pixels[:, 4:, 3] = 255, 0
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=made.DISPLAY_P3)
    write_image(tmp_path / "g.png", 77, (8, 8))
    views = [make_view(tmp_path / name, size=(8, 8)) for name in ("a.png", "g.png")]
    store = ImageStore(views, DataConfig())
    np.testing.assert_array_equal(store.stored(0)[1], pixels[..., 3] > 0)
    assert (store.stored(1)[0] == 77).all()


def test_colours_in_the_header_of_a_png_are_converted(tmp_path: Path) -> None:
    def numbers(values: Sequence[float]) -> bytes:
        return struct.pack(f">{len(values)}I", *(round(1e5 * v) for v in values))

    white_first = (*icc.DISPLAY_P3[6:], *icc.DISPLAY_P3[:6])
    cases: dict[str, tuple[dict[bytes, bytes], Any, icc.Primaries]] = {
        "linear": ({b"gAMA": numbers([1])}, lambda x: x, icc.BT709),
        "p3": (
            {b"gAMA": numbers([0.45455]), b"cHRM": numbers(white_first)},
            srgb_decode,
            icc.DISPLAY_P3,
        ),
        "pq": ({b"cICP": bytes([9, 16, 0, 1])}, lambda x: icc.to_light(x, "pq"), icc.BT2020),
        "srgb": ({b"gAMA": numbers([1]), b"sRGB": b"\0"}, srgb_decode, icc.BT709),
        "plain": ({b"gAMA": numbers([0.45455]), b"cHRM": numbers([0] * 8)}, srgb_decode, icc.BT709),
    }
    views = [make_view(tmp_path / f"{name}.png", size=(96, 64)) for name in cases]
    for view, (chunks, _, _) in zip(views, cases.values(), strict=True):
        header = PngInfo()
        for key, data in chunks.items():
            header.add(key, data)
        Image.fromarray(PIXELS).save(view.image_path, pnginfo=header)
    store = ImageStore(views, DataConfig())
    for k, (_, decode, primaries) in enumerate(cases.values()):
        pixels = store.stored(k)[0]
        expected = decode(PIXELS / 255) @ icc.to_srgb_matrix(primaries).T
        shown = pixels / np.iinfo(pixels.dtype).max
        np.testing.assert_allclose(shown, icc.encode_16(expected) / 65535, atol=2e-3)
    notes = colour_notes(view.image_path for view in views)
    assert notes == ("3 photographs are in the colour space of their PNG headers; they are "
                     "converted to sRGB.",)  # fmt: skip


def test_adobe_rgb_is_recognised_by_exif_alone() -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    data = io.BytesIO()
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(data, "JPEG", exif=exif)
    with Image.open(data) as image:
        profile = profile_of(image)
    assert profile is not None
    assert profile.name == adobe_rgb().name
    written = read_profile(made.ADOBE_RGB)
    assert written is not None
    assert written.matrix is not None
    assert adobe_rgb().matrix == pytest.approx(written.matrix, abs=2e-3)
