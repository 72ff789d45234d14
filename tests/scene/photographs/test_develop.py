"""HEIC, raw and linear light, from their files to what the store gives and the user is told."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pillow_heif
import pytest
from PIL import Image, features
from scene.photographs.made import DISPLAY_P3, patches, settings, write_dng

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.errors import UserError
from p2gs_jax.scene.convert.convert import Converted, convert_photographs
from p2gs_jax.scene.convert.headers import read_exif_ev, read_exif_settings
from p2gs_jax.scene.convert.kinds import has_gain_map, kind_of
from p2gs_jax.scene.files import image_size, list_images


def developed(folder: Path, work: Path | None = None) -> Converted:
    work = work or folder.parent / "work"
    return convert_photographs(folder, list_images(folder), work, lambda message: None)


def light_of(path: Path) -> np.ndarray:
    codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert codes.dtype == np.uint16
    return srgb_decode(codes[..., 2::-1] / 65535)


def record_of(result: Converted) -> list[dict]:
    return json.loads((result.folder / "photographs.json").read_text())["photographs"]


def write_exr(path: Path, light: np.ndarray, names: str = "RGB", **header) -> None:
    channels = {c: np.ascontiguousarray(light[..., i]) for i, c in enumerate(names)}
    with OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, channels) as file:
        file.write(str(path))


def save_heic(path: Path, pixels: np.ndarray, **options) -> None:
    mode = "RGB;16" if pixels.dtype == np.uint16 else "RGB"
    size = (pixels.shape[1], pixels.shape[0])
    image = pillow_heif.from_bytes(mode, size, np.ascontiguousarray(pixels).tobytes())
    image.save(path, quality=100, chroma=444, **options)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "photos").mkdir()
    return tmp_path / "photos"


def test_ordinary_photographs_stay_where_they_are(folder: Path) -> None:
    for name in ("a.jpg", "b.png"):
        cv2.imwrite(str(folder / name), np.full((8, 8, 3), 90, np.uint8))
    result = developed(folder)
    assert result.folder == folder
    assert [path.name for path in result.paths] == ["a.jpg", "b.png"]
    assert result.known is None
    assert not (folder.parent / "work").exists()


# ---------------------------------------------------------------------- raw


def test_raw_is_linear_above_its_black_level(folder: Path) -> None:
    light = 0.02 + 0.8 * patches((96, 64)) ** 2
    write_dng(folder / "a.dng", light, orientation=6)
    write_dng(folder / "b.dng", light / 4, orientation=1)
    result = developed(folder)
    assert result.known == "camera raw"
    bright, dark = (light_of(path) for path in result.paths)
    assert bright.shape == (64, 96, 3)  # as the sensor lies, whatever the orientation
    inner = (slice(8, -8), slice(8, -8))
    # The rest is LibRaw's guess between the pixels of the filter.
    assert np.percentile(np.abs(bright - light)[inner], 99) < 0.02
    # Two stops are two stops, down to the dark: black was subtracted and nothing was brightened.
    ratio = bright[inner] / dark[inner]
    assert np.median(ratio) == pytest.approx(4, rel=2e-3)
    assert np.percentile(np.abs(ratio - 4), 95) < 0.1


def test_sensor_white_is_saturated_in_all_channels(folder: Path) -> None:
    write_dng(folder / "a.dng", np.full((64, 96, 3), 3.0))
    result = developed(folder)
    assert light_of(result.paths[0]).min() == pytest.approx(1, abs=1e-4)
    assert record_of(result)[0]["saturated"] == 1


def _neutral(balance: tuple[float, ...]) -> bytes:
    """Return the tag AsShotNeutral as `write_dng` writes it."""
    return b"".join(struct.pack("<II", round(1e6 / b), 1_000_000) for b in balance)


def test_one_white_balance_for_all_raws_of_a_camera(folder: Path) -> None:
    # The same light and sensor; the camera changed its mind about white.
    light = np.full((64, 96, 3), (0.2, 0.3, 0.25))
    for name, chosen in {"a": (2.0, 1, 1.5), "b": (2.2, 1, 1.4), "c": (1.6, 1, 1.8)}.items():
        write_dng(folder / f"{name}.dng", light, balance=(2.0, 1, 1.5))
        data = (folder / f"{name}.dng").read_bytes()
        neutral, asked = (_neutral(balance) for balance in ((2.0, 1, 1.5), chosen))
        assert neutral in data
        (folder / f"{name}.dng").write_bytes(data.replace(neutral, asked))
    result = developed(folder)
    colours = [light_of(path)[32, 48] for path in result.paths]
    np.testing.assert_allclose(colours, np.broadcast_to((0.2, 0.3, 0.25), (3, 3)), atol=2e-3)
    chosen = [r["balance"] for r in record_of(result)]
    assert chosen[1] == pytest.approx((2.2, 1, 1.4), rel=1e-3)
    (note,) = (note for note in result.notes if note.startswith("White balance of 3"))
    assert "red 2.000, blue 1.500" in note


def test_exif_of_raw_reaches_the_developed_file(folder: Path) -> None:
    write_dng(folder / "a.dng", np.full((64, 96, 3), 0.3), time=(1, 250), iso=400)
    expected = np.log2(1 / 250 * 400 / 2.8**2)
    assert read_exif_ev(folder / "a.dng") == pytest.approx(expected, abs=1e-3)
    path = developed(folder).paths[0]
    assert read_exif_ev(path) == pytest.approx(expected, abs=1e-3)
    assert read_exif_settings(path).time == pytest.approx(1 / 250)
    assert image_size(folder / "a.dng") == (96, 64)


def test_raw_of_an_unknown_camera(folder: Path) -> None:
    (folder / "a.nef").write_bytes(b"II*\0" + bytes(range(256)) * 40)
    with pytest.raises(UserError, match=r"does not know .*a\.nef") as error:
        developed(folder)
    assert "DNG Converter" in str(error.value.fix)


def test_truncated_raw(folder: Path) -> None:
    write_dng(folder / "a.dng", np.full((64, 96, 3), 0.3))
    data = (folder / "a.dng").read_bytes()
    (folder / "a.dng").write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match=r"a\.dng"):
        developed(folder)


@pytest.mark.parametrize(
    ("module", "name", "command"),
    [("rawpy", "a.dng", "p2gs-jax[raw]"), ("pillow_heif", "a.heic", "p2gs-jax[heic]")],
)
def test_what_to_install(folder: Path, monkeypatch, module: str, name: str, command: str) -> None:
    (folder / name).write_bytes(b"whatever")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError) as error:
        developed(folder)
    assert name in str(error.value)
    assert f"pip install '{command}'" in str(error.value.fix)


def test_raw_beside_jpeg_is_one_photograph(folder: Path) -> None:
    write_dng(folder / "a.dng", np.full((64, 96, 3), 0.3))
    cv2.imwrite(str(folder / "a.jpg"), np.full((64, 96, 3), 90, np.uint8))
    result = developed(folder)
    assert list(result.originals.values()) == [folder / "a.dng"]
    assert any("there twice" in note for note in result.notes)


def test_without_rawpy_the_jpeg_beside_it_is_used(folder: Path, monkeypatch) -> None:
    write_dng(folder / "a.dng", np.full((64, 96, 3), 0.3))
    cv2.imwrite(str(folder / "a.jpg"), np.full((64, 96, 3), 90, np.uint8))
    monkeypatch.setattr("p2gs_jax.scene.convert.convert.find_spec", lambda name: None)
    result = developed(folder)
    assert list(result.originals.values()) == [folder / "a.jpg"]
    assert result.known is None


# --------------------------------------------------------------------- HEIC


def test_heic_keeps_its_values_profile_and_settings(folder: Path) -> None:
    pixels = (40 + 150 * patches()).astype(np.uint8)
    exif = settings().tobytes()
    save_heic(folder / "a.heic", pixels, exif=exif, icc_profile=DISPLAY_P3)
    assert image_size(folder / "a.heic") == (96, 64)
    result = developed(folder)
    assert result.known is None  # a phone's own curve is in it
    path = result.paths[0]
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint8
    assert np.abs(stored[..., ::-1].astype(int) - pixels).max() <= 4
    with Image.open(path) as image:
        assert image.info["icc_profile"] == DISPLAY_P3
    assert read_exif_ev(path) == pytest.approx(read_exif_ev(folder / "a.heic"))
    assert read_exif_ev(path) == pytest.approx(np.log2(200 / 60 / 2.8**2), abs=1e-3)


def test_ten_bit_heic_keeps_its_precision(folder: Path) -> None:
    ramp = np.linspace(20_000, 22_000, 96).astype(np.uint16)
    pixels = np.broadcast_to(ramp[None, :, None], (64, 96, 3))
    save_heic(folder / "a.heic", pixels)
    stored = cv2.imread(str(developed(folder).paths[0]), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    assert len(np.unique(stored[32, :, 1])) > 25  # 8 bits have 8 levels here


def test_broken_heic(folder: Path) -> None:
    save_heic(folder / "a.heic", np.zeros((64, 96, 3), np.uint8))
    data = (folder / "a.heic").read_bytes()
    (folder / "a.heic").write_bytes(data[: len(data) - 60])
    with pytest.raises(UserError, match=r"a\.heic cannot be decoded"):
        developed(folder)


# ------------------------------------------------------------ AVIF and WebP


@pytest.mark.parametrize(
    ("kind", "how"),
    [("avif", {"quality": 100, "subsampling": "4:4:4"}), ("webp", {"lossless": True})],
)
def test_what_pillow_reads_keeps_its_values_profile_and_settings(
    folder: Path, kind: str, how: dict
) -> None:
    if not features.check(kind):
        pytest.skip(f"this Pillow knows no {kind}")
    pixels, file = (40 + 150 * patches()).astype(np.uint8), folder / f"a.{kind}"
    how = {**how, "exif": settings().tobytes()}
    Image.fromarray(pixels).save(file, icc_profile=DISPLAY_P3, **how)
    assert image_size(file) == (96, 64)
    result = developed(folder)
    assert result.known is None
    path = result.paths[0]
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert np.abs(stored[..., ::-1].astype(int) - pixels).max() <= 4
    with Image.open(path) as image:
        assert image.info["icc_profile"] == DISPLAY_P3
    assert read_exif_ev(path) == pytest.approx(np.log2(200 / 60 / 2.8**2), abs=1e-3)
    file.write_bytes(file.read_bytes()[: 300 if kind == "avif" else -40])
    with pytest.raises(UserError, match=rf"a\.{kind} cannot be decoded"):
        developed(folder)


# ------------------------------------------------------------- linear light


def test_exr_keeps_light_between_photographs(folder: Path) -> None:
    light = (0.001 + 6 * patches() ** 3).astype(np.float32)
    write_exr(folder / "a.exr", light)
    write_exr(folder / "b.exr", light / 8)
    assert image_size(folder / "a.exr") == (96, 64)
    result = developed(folder)
    assert result.known == "linear EXR"
    scale = record_of(result)[0]["scale"]
    assert scale == record_of(result)[1]["scale"] == 0.125
    bright, dark = (light_of(path) for path in result.paths)
    np.testing.assert_allclose(bright, np.minimum(light * scale, 1), atol=1e-4)
    seen = dark > 1e-3
    assert np.median(bright[seen] / dark[seen]) == pytest.approx(8, rel=5e-3)
    assert any("multiplied by 0.125" in note for note in result.notes)


def test_exr_of_a_sensor_keeps_its_white(folder: Path) -> None:
    write_exr(folder / "a.exr", np.minimum(patches() * 1.3, 1).astype(np.float32))
    assert record_of(developed(folder))[0]["scale"] == 1


def test_exr_that_is_broken_inside(folder: Path) -> None:
    light = np.full((8, 8, 3), 0.5, np.float32)
    light[0, 0], light[0, 1], light[0, 2] = np.nan, np.inf, -1
    write_exr(folder / "a.exr", light)
    result = developed(folder)
    assert any("1 pixels of linear photographs are not numbers" in note for note in result.notes)
    out = light_of(result.paths[0])
    assert (out[0, 0] == 0).all()
    assert (out[0, 1] == 1).all()
    assert (out[0, 2] == 0).all()


def test_exr_grey_alpha_and_chromaticities(folder: Path) -> None:
    grey = np.full((8, 8, 1), 0.3, np.float32)
    write_exr(folder / "a.exr", grey, "Y", expTime=0.01, aperture=4.0, isoSpeed=100.0)
    clear = np.full((8, 8, 4), 0.5, np.float32) * (0.6, 0.6, 0.6, 1)
    write_exr(folder / "b.exr", clear.astype(np.float32), "RGBA")
    p3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)
    green = np.broadcast_to(np.array([0, 0.5, 0], np.float32), (8, 8, 3))
    write_exr(folder / "c.exr", green, chromaticities=p3)
    result = developed(folder)
    assert light_of(result.paths[0])[4, 4] == pytest.approx(0.3, abs=1e-4)
    assert read_exif_ev(result.paths[0]) == pytest.approx(np.log2(0.01 * 100 / 16), abs=1e-3)
    stored = cv2.imread(str(result.paths[1]), cv2.IMREAD_UNCHANGED)
    assert stored.shape[2] == 4
    assert light_of(result.paths[1])[4, 4] == pytest.approx(0.6, abs=1e-3)
    assert stored[4, 4, 3] / 65535 == pytest.approx(0.5, abs=1e-3)
    assert light_of(result.paths[2])[4, 4] == pytest.approx((0, 0.521, 0), abs=2e-3)


def test_no_exr(folder: Path) -> None:
    (folder / "a.exr").write_bytes(b"\x76\x2f\x31\x01 and nothing")
    with pytest.raises(UserError, match=r"a\.exr is not a readable OpenEXR"):
        developed(folder)


def test_depth_alone_is_no_photograph(folder: Path) -> None:
    write_exr(folder / "a.exr", np.ones((8, 8, 1), np.float32), "Z")
    with pytest.raises(UserError, match="has the channels Z"):
        developed(folder)


def test_tiff_of_floats_is_light_and_of_integers_is_not(folder: Path) -> None:
    light = (0.9 * patches()).astype(np.float32)
    cv2.imwrite(str(folder / "a.tif"), light[..., ::-1])
    assert kind_of(folder / "a.tif") == "float_tiff"
    result = developed(folder)
    assert result.known == "TIFF of floats"
    np.testing.assert_allclose(light_of(result.paths[0]), light, atol=1e-4)
    codes = np.rint(srgb_encode(light) * 65535).astype(np.uint16)
    cv2.imwrite(str(folder / "a.tif"), codes[..., ::-1])
    assert kind_of(folder / "a.tif") == "plain"


# -------------------------------------------------------------------- mixed


def test_kinds_beside_each_other(folder: Path) -> None:
    (folder / "sub").mkdir()
    write_dng(folder / "sub" / "a.dng", np.full((64, 96, 3), 0.3))
    cv2.imwrite(str(folder / "b.jpg"), np.full((64, 96), 90, np.uint8))
    result = developed(folder)
    assert [p.relative_to(result.folder).as_posix() for p in result.paths] == ["b.jpg", "sub/a.png"]
    assert (result.folder / "b.jpg").read_bytes() == (folder / "b.jpg").read_bytes()
    assert result.known is None
    assert any("of several kinds (1 " in note for note in result.notes)


def test_developed_once(folder: Path) -> None:
    write_dng(folder / "a.dng", np.full((64, 96, 3), 0.3))
    path = developed(folder).paths[0]
    before = path.stat().st_mtime_ns
    assert developed(folder).paths[0].stat().st_mtime_ns == before
    write_dng(folder / "a.dng", np.full((64, 96, 3), 0.6))
    assert light_of(developed(folder).paths[0])[32, 48, 1] == pytest.approx(0.6, abs=5e-3)


def test_gain_maps_are_found_in_headers_only(folder: Path) -> None:
    plain = folder / "a.jpg"
    Image.fromarray(np.zeros((64, 96, 3), np.uint8)).save(plain)
    assert not has_gain_map(plain)
    data = plain.read_bytes()
    xmp = b'http://ns.adobe.com/xap/1.0/\0<x xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/"/>'
    iso = b"urn:iso:std:iso:ts:21496:-1\0\0\0\0\0"
    for marker, payload in ((b"\xff\xe1", xmp), (b"\xff\xe2", iso)):
        segment = marker + (len(payload) + 2).to_bytes(2, "big") + payload
        (folder / "b.jpg").write_bytes(data[:2] + segment + data[2:])
        assert has_gain_map(folder / "b.jpg")
    # The second picture of such a file, behind the first, is no header.
    (folder / "c.jpg").write_bytes(data + iso)
    assert not has_gain_map(folder / "c.jpg")
