"""Colour profiles: against LittleCMS, which Pillow carries."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms
from scene.convert.made import ADOBE_RGB, DISPLAY_P3, patches
from scene.helpers import make_view, write_image

from p2gs_jax.config import DataConfig
from p2gs_jax.scene.convert.icc import adobe_rgb, colour_notes, profile_of, read_profile, to_srgb
from p2gs_jax.scene.pixels.store import ImageStore

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
TABLES = DISPLAY_P3.replace(b"rXYZ", b"A2B0")
PIXELS = (40 + 150 * patches()).astype(np.uint8)


@pytest.mark.parametrize(("data", "name"), [(DISPLAY_P3, "Display P3"), (ADOBE_RGB, "Adobe RGB")])
def test_colours_are_those_of_littlecms(data: bytes, name: str) -> None:
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
    # It is a change that matters, or nothing would be tested.
    assert np.abs(theirs - PIXELS).max() > 10
    # Grey stays grey.
    grey = np.repeat(np.array([[30, 128, 255]], np.uint8)[..., None], 3, 2)
    out = to_srgb(grey, profile).astype(float)
    assert np.ptp(out, axis=2).max() < 0.004 * 65535
    assert out[0, 2].min() > 0.998 * 65535


def test_srgb_broken_and_tabulated_profiles() -> None:
    for data in (SRGB, b"", DISPLAY_P3[:200]):
        assert read_profile(data) is None
    profile = read_profile(TABLES)
    assert profile is not None
    assert profile.decode is None
    assert to_srgb(PIXELS, profile) is PIXELS


def test_a_store_converts_and_the_user_is_told(tmp_path: Path) -> None:
    profiles = {"a.png": None, "b.png": DISPLAY_P3, "c.png": TABLES}
    views = [make_view(tmp_path / name, size=(96, 64)) for name in profiles]
    for view, data in zip(views, profiles.values(), strict=True):
        Image.fromarray(PIXELS).save(view.image_path, **({"icc_profile": data} if data else {}))
    kept, changed, tabulated = (ImageStore(views, DataConfig()).stored(k)[0] for k in range(3))
    assert kept.dtype == np.uint8  # what needs no precision takes no memory for it
    assert changed.dtype == np.uint16
    profile = read_profile(DISPLAY_P3)
    assert profile is not None
    np.testing.assert_array_equal(changed, to_srgb(PIXELS, profile))
    np.testing.assert_array_equal(tabulated, PIXELS)
    notes = colour_notes(view.image_path for view in views)
    assert notes[0] == "1 photographs are in Display P3; they are converted to sRGB."
    assert "not applied" in notes[1]


def test_alpha_beside_a_profile_is_kept_and_grey_has_none(tmp_path: Path) -> None:
    pixels = np.full((8, 8, 4), 100, np.uint8)
    pixels[:, :4, 3], pixels[:, 4:, 3] = 255, 0
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=DISPLAY_P3)
    write_image(tmp_path / "g.png", 77, (8, 8))
    views = [make_view(tmp_path / name, size=(8, 8)) for name in ("a.png", "g.png")]
    store = ImageStore(views, DataConfig())
    np.testing.assert_array_equal(store.stored(0)[1], pixels[..., 3] > 0)
    assert (store.stored(1)[0] == 77).all()


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
