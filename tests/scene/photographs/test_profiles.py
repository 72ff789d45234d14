"""Colour profiles: against LittleCMS, which Pillow carries."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms
from scene.photographs.made import ADOBE_RGB, DISPLAY_P3, patches

from p2gs_jax.config import DataConfig
from p2gs_jax.scene.convert.icc import adobe_rgb, colour_notes, profile_of, read_profile, to_srgb
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import View

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def view_of(path: Path, size: tuple[int, int]) -> View:
    eye = np.eye(4, dtype=np.float32)
    return View(path.name, path, "0", eye, eye[:3, :3], *size)


@pytest.mark.parametrize(("data", "name"), [(DISPLAY_P3, "Display P3"), (ADOBE_RGB, "Adobe RGB")])
def test_colours_are_those_of_littlecms(data: bytes, name: str) -> None:
    profile = read_profile(data)
    assert profile is not None
    assert profile.name.startswith(name)
    pixels = (40 + 150 * patches()).astype(np.uint8)
    ours = to_srgb(pixels, profile) / 257
    source = ImageCms.ImageCmsProfile(io.BytesIO(data))
    target = ImageCms.createProfile("sRGB")
    theirs = np.asarray(
        ImageCms.profileToProfile(
            Image.fromarray(pixels), source, target, ImageCms.Intent.RELATIVE_COLORIMETRIC
        ),
        float,
    )
    inside = (theirs > 0) & (theirs < 255)
    assert inside.mean() > 0.9
    assert np.abs(ours - theirs)[inside].max() < 1.5
    # It is a change that matters, or nothing would be tested.
    assert np.abs(theirs - pixels).max() > 10


def test_grey_stays_grey() -> None:
    for data in (DISPLAY_P3, ADOBE_RGB):
        profile = read_profile(data)
        assert profile is not None
        grey = np.repeat(np.array([[30, 128, 255]], np.uint8)[..., None], 3, 2)
        out = to_srgb(grey, profile).astype(float)
        assert np.ptp(out, axis=2).max() < 0.004 * 65535
        assert out[0, 2].min() > 0.998 * 65535


def test_srgb_broken_and_tabulated_profiles() -> None:
    assert read_profile(SRGB) is None
    assert read_profile(b"") is None
    assert read_profile(DISPLAY_P3[:200]) is None
    tables = DISPLAY_P3.replace(b"rXYZ", b"A2B0")
    profile = read_profile(tables)
    assert profile is not None
    assert profile.decode is None
    pixels = np.zeros((2, 2, 3), np.uint8)
    assert to_srgb(pixels, profile) is pixels


def test_a_store_converts_and_the_user_is_told(tmp_path: Path) -> None:
    pixels = (40 + 150 * patches()).astype(np.uint8)
    plain, wide, tabulated = (tmp_path / name for name in ("a.png", "b.png", "c.png"))
    Image.fromarray(pixels).save(plain)
    Image.fromarray(pixels).save(wide, icc_profile=DISPLAY_P3)
    Image.fromarray(pixels).save(tabulated, icc_profile=DISPLAY_P3.replace(b"rXYZ", b"A2B0"))
    views = [view_of(path, (96, 64)) for path in (plain, wide, tabulated)]
    store = ImageStore(views, DataConfig())
    kept, _ = store.stored(0)
    changed, _ = store.stored(1)
    assert kept.dtype == np.uint8  # what needs no precision takes no memory for it
    assert changed.dtype == np.uint16
    profile = read_profile(DISPLAY_P3)
    assert profile is not None
    np.testing.assert_array_equal(changed, to_srgb(pixels, profile))
    np.testing.assert_array_equal(store.stored(2)[0], pixels)
    notes = colour_notes(view.image_path for view in views)
    assert notes[0] == "1 photographs are in Display P3; they are converted to sRGB."
    assert "not applied" in notes[1]


def test_alpha_beside_a_profile_is_kept(tmp_path: Path) -> None:
    pixels = np.full((8, 8, 4), 100, np.uint8)
    pixels[:, :4, 3] = 255
    pixels[:, 4:, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=DISPLAY_P3)
    _, valid = ImageStore([view_of(tmp_path / "a.png", (8, 8))], DataConfig()).stored(0)
    assert valid[:, :4].all()
    assert not valid[:, 4:].any()


def test_adobe_rgb_marked_by_exif_alone() -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    data = io.BytesIO()
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(data, "JPEG", exif=exif)
    with Image.open(data) as image:
        profile = profile_of(image)
    assert profile is not None
    assert profile.name == adobe_rgb().name
    icc = read_profile(ADOBE_RGB)
    assert icc is not None
    assert icc.matrix is not None
    assert adobe_rgb().matrix == pytest.approx(icc.matrix, abs=2e-3)


def test_grey_photographs_with_a_profile_stay_as_they_are(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "g.png"), np.full((8, 8), 77, np.uint8))
    pixels, _ = ImageStore([view_of(tmp_path / "g.png", (8, 8))], DataConfig()).stored(0)
    assert (pixels == 77).all()
