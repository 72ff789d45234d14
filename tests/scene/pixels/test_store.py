"""Photographs from a store, and the files of those that memory does not hold."""

import contextlib
import dataclasses
import errno
import os
import shutil
import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from PIL import Image
from scene.helpers import make_view, refused

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import ImageStore, size_at
from p2gs_jax.scene.lens import undistort_points
from p2gs_jax.scene.masks import has_alpha
from p2gs_jax.scene.pixels import cache, decode
from p2gs_jax.scene.pixels import store as store_module
from p2gs_jax.scene.pixels.store import decoded_into
from p2gs_jax.types import Distortion

RNG = np.random.default_rng(0)


def noise(*shape, dtype=np.uint8):
    return RNG.integers(0, np.iinfo(dtype).max, (48, 64, *shape), dtype=dtype, endpoint=True)


def store_of(*views, **options):
    return ImageStore(views, DataConfig(**options))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_rgb_order_exact_values_grey_and_alpha(tmp_path, dtype, channels):
    raw, top = noise(*channels, dtype=dtype), np.float32(np.iinfo(dtype).max)
    ldr, mask = store_of(make_view(tmp_path / "a.png", raw)).get(0)
    assert ldr.dtype == mask.dtype == np.float32
    colours = raw[..., 2::-1] if channels else np.repeat(raw[..., None], 3, 2)
    assert np.array_equal(ldr, colours.astype(np.float32) / top)
    opaque = raw[..., 3] >= top / 2 if channels == (4,) else np.ones((48, 64))
    assert np.array_equal(mask, opaque)


def tiff(pixels, meaning, planes=1):
    """Return a TIFF whose fourth channel has this meaning: 1 is associated alpha, 2 straight."""
    height, width = pixels.shape[:2]
    tags = {256: width, 257: height, 258: 146, 259: 1, 262: 2, 273: 154, 277: 4, 278: height}
    tags |= {279: pixels.nbytes, 284: planes, 338: meaning}
    rows = (struct.pack("<HHII", t, 3, 4 if t == 258 else 1, v) for t, v in tags.items())
    head = struct.pack("<4sIH", b"II*\0", 8, len(tags)) + b"".join(rows) + bytes(4)
    return head + struct.pack("<4H", *[8 * pixels.itemsize] * 4) + pixels.tobytes()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_colours_of_a_tiff_are_not_multiplied_by_its_alpha(tmp_path, dtype):
    most, path = np.iinfo(dtype).max, tmp_path / "a.tif"
    straight = (np.array([200, 100, 50, 128]) / 255 * most).astype(dtype)
    associated = np.append(straight[:3] * (straight[3] / most), straight[3]).astype(dtype)
    for pixel, meaning in ((straight, 2), (associated, 1), (straight, 0)):
        path.write_bytes(tiff(np.tile(pixel, (30, 40, 1)), meaning))
        pixels, _, alpha = decode.stored(make_view(path, size=(40, 30)))
        np.testing.assert_allclose(pixels[0, 0] / most, [200 / 255, 100 / 255, 50 / 255], atol=0.01)
        assert (None if alpha is None else alpha[0, 0]) == (straight[3] if meaning else None)
        assert has_alpha(path) == (alpha is not None)
    # OpenCV reads the first of separate planes only.
    if dtype == np.uint16:
        path.write_bytes(tiff(np.zeros((1, 1, 4), dtype), 2, planes=2))
        with refused("a.tif is a TIFF of 16 bits with separate planes"):
            decode.stored(make_view(path, size=(1, 1)))


@pytest.mark.parametrize("turned", [3, 6])
def test_a_tiff_that_opencv_turns_is_refused(tmp_path, turned):
    # Poses belong to the stored pixels, as those of JPEG.
    Image.new("RGB", (8, 4)).save(tmp_path / "a.tif", tiffinfo={274: turned})
    with refused("a.tif is a TIFF with an orientation"):
        decode.stored(make_view(tmp_path / "a.tif", size=(8, 4)))


def test_a_tiff_of_lab_values_is_refused(tmp_path):
    Image.new("LAB", (8, 4)).save(tmp_path / "a.tif")
    with refused(r"a.tif is a TIFF of L\*a\*b\* values"):
        decode.stored(make_view(tmp_path / "a.tif", size=(8, 4)))


@pytest.mark.parametrize(
    ("name", "mode"), [("a.png", "L"), ("a.png", "I;16"), ("a.png", "1"), ("a.tif", "LA")]
)
def test_alpha_of_grey_photographs_is_read(tmp_path, name, mode):
    image = Image.fromarray(np.tile(np.uint8([[0, 255]]), (4, 4)))
    image = image.convert(mode)
    if mode == "LA":
        image.putalpha(image.getchannel("L"))
    image.save(tmp_path / name, transparency=0)
    assert has_alpha(tmp_path / name)
    _, valid, alpha = decode.stored(make_view(tmp_path / name, size=(8, 4)))
    assert np.array_equal(valid, np.tile([[False, True]], (4, 4)))
    assert alpha is not None


@pytest.mark.parametrize("white", [1, 100, 255, 1023, 65535])
@pytest.mark.parametrize("kind", ["P2", "P3", "P5", "P6"])
def test_the_header_of_a_pgm_or_ppm_states_white(tmp_path, kind, white):
    values = np.array([white // 3, 0, white][: 3 if kind in ("P3", "P6") else 1])
    stored = values.astype(">u2" if white > 255 else "u1").tobytes()
    content = stored if kind > "P3" else " ".join(map(str, values)).encode() + b"\n"
    (tmp_path / "a.ppm").write_bytes(f"{kind} 1 # wide\n1\n{white}\n".encode() + content)
    ldr, _ = store_of(make_view(tmp_path / "a.ppm", size=(1, 1))).get(0)
    np.testing.assert_allclose(ldr[0, 0] - values / white, 0, atol=1 / 255 if white < 256 else 1e-4)


@pytest.mark.parametrize(("clipped", "accepted"), [(9, False), (1, True)])
def test_values_of_12_bits_in_16_bits_are_refused(tmp_path, clipped, accepted):
    raw = np.random.default_rng(0).integers(0, 4095, (120, 100, 3)).astype(np.uint16)
    raw[:clipped, 0] = 4095
    view = make_view(tmp_path / "a.png", raw)
    if accepted:
        decode.stored(view)
    else:
        with refused("a.png has 16 bits, but its white is 4095: its values have 12 bits"):
            decode.stored(view)


def test_sizes_and_intrinsics(tmp_path):
    view = make_view(tmp_path / "a.png", size=(1000, 751))
    assert size_at(view, None) == size_at(view, 2000) == (1000, 751)
    assert size_at(view, 500, 2) == (250, 188)
    assert size_at(view, None, 4000) == (1, 1)
    _, K, w, h = store_of(view, max_width=500).camera(0, 2)
    assert K.dtype == np.float32
    # The image's corners stay its corners.
    assert (K[0, 2] / w, K[1, 2] / h) == pytest.approx((0.5, 0.5))
    assert (K[0, 0] / w, K[1, 1] / h) == pytest.approx((60 / 1000, 60 / 751))


def test_traces_of_jpeg_around_a_mask_do_not_count(tmp_path):
    mask = np.full((48, 64), 255, np.uint8)
    mask[11:29, 13:41] = 0
    cv2.imwrite(str(tmp_path / "m.jpg"), mask, (cv2.IMWRITE_JPEG_QUALITY, 75))
    _, valid = store_of(make_view(tmp_path / "a.png", noise(3), mask_path=tmp_path / "m.jpg")).get(
        0
    )
    np.testing.assert_array_equal(valid > 0, mask > 0)


def test_shrinking_averages_and_masks_conservatively(tmp_path):
    bgr, mask = noise(3), np.full((48, 64), 255, np.uint8)
    mask[5, 9] = 0
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    view = make_view(tmp_path / "a.png", bgr, mask_path=tmp_path / "m.png")
    ldr, valid = store_of(view).get(0, 4)
    expected = bgr[..., ::-1].reshape(12, 4, 16, 4, 3).mean((1, 3)) / 255
    assert np.allclose(ldr, expected, atol=0.6 / 65535)
    assert valid[1, 2] == 0.0
    assert valid.sum() == valid.size - 1
    # A whole photograph does not depend on the width of a fit, and is not kept.
    small = store_of(view, max_width=16)
    np.testing.assert_array_equal(small.whole(0)[0], bgr[..., ::-1] / np.float32(255))
    assert small._photographs._bytes == 0


def _pattern(x, y):
    return 0.5 + 0.4 * np.sin(x / 7.0) * np.cos(y / 9.0)


@pytest.mark.parametrize(
    "lens",
    [
        Distortion((-0.15, 0.05, 0.002, -0.001)),
        Distortion((0.3, 0.1, 0.001, -0.002, 0.02, 0.6, 0.2, 0.05)),
        Distortion((0.05, -0.02, 0.01, -0.004), "fisheye"),
    ],
    ids=["radial", "rational", "fisheye"],
)
def test_undistortion_puts_pixels_where_the_pinhole_expects_them(tmp_path, lens):
    """A scene painted in undistorted coordinates, photographed with distortion, comes back."""
    w, h, f = 320, 240, 300.0
    K = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]])
    centres = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1)
    # Points are held to OpenCV's formulas in test_lens_models.py.
    rays = undistort_points(centres.reshape(-1, 2), K, lens).reshape(h, w, 2)
    image = np.round(_pattern(rays[..., 0], rays[..., 1]) * 65535).astype(np.uint16)
    ldr, mask = store_of(make_view(tmp_path / "a.png", image, f=f, distortion=lens)).get(0)
    truth = _pattern(centres[..., 0], centres[..., 1])
    inside = mask > 0
    assert inside.mean() > 0.5
    assert np.abs(ldr[..., 0] - truth)[inside].max() < 3e-3  # an error of half a pixel gives 3e-2


def test_cache_is_bounded_and_reused(tmp_path):
    image = np.zeros((512, 512, 3), np.uint8)  # 1 MiB with its mask
    views = [make_view(tmp_path / f"{i}.png", image + i) for i in range(6)]
    store = store_of(*views, cache_mb=3)
    for i in range(6):
        assert store.get(i)[0].max() == np.float32(i / 255)
        assert store._photographs._bytes <= 3 * 2**20
    for view in views[3:]:
        view.image_path.unlink()
    for i in (3, 4, 5):
        store.get(i)
    views[0].image_path.unlink()
    with refused(r"cannot read .*0.png"):
        store.get(0)


def test_decoding_ahead_is_bounded_on_many_cores(tmp_path, monkeypatch):
    monkeypatch.setattr(store_module, "DECODERS", 3)
    monkeypatch.setattr(store_module, "MOST_PENDING", 4)
    store = store_of(*(make_view(tmp_path / f"{k}.png", noise(3)) for k in range(9)))
    photographs, gate = store._photographs, threading.Event()
    monkeypatch.setattr(photographs, "_load", lambda key: gate.wait(60))
    for k in range(9):
        store.prefetch(k)
    waiting = len(photographs._pending)
    gate.set()
    assert waiting == 4


def test_prefetch_from_many_threads(tmp_path):
    views = [make_view(tmp_path / f"{i}.png", np.full((64, 64), i, np.uint8)) for i in range(20)]
    store = store_of(*views, cache_mb=1)

    def work(i):
        store.prefetch(7 * i % 20, 1.0 + i % 2)
        return store.get(i)[0].max()

    asked = RNG.integers(0, 20, 400)
    with ThreadPoolExecutor(4) as threads:
        np.testing.assert_array_equal([*threads.map(work, asked)], np.float32(asked / 255))
    store.close()
    assert store._photographs._bytes == 0
    gone = store_of(make_view(tmp_path / "gone.png"))
    gone.prefetch(0)
    with refused(r"gone.png"):
        gone.get(0)


def test_truncated_images_changed_sizes_and_floats_are_refused(tmp_path):
    view = make_view(tmp_path / "a.jpg", noise(3))
    view.image_path.write_bytes(view.image_path.read_bytes()[:2000])
    with refused(r"cannot decode .*a\.jpg"):
        store_of(view).get(0)
    view = make_view(tmp_path / "a.png", noise())
    cv2.imwrite(str(view.image_path), np.zeros((24, 32), np.uint8))
    with refused("32x24 pixels, but had 64x48"):
        store_of(view).get(0)
    view = make_view(tmp_path / "a.tiff", np.zeros((48, 64, 3), np.float32))
    with refused(r"a.tiff has float32 pixels"):
        store_of(view).get(0)


SIZE, SHRINKS = (48, 64), (2, 1)
NONE = DataConfig(cache_mb=0)


def noisy_view(folder, name, channels=3, dtype=np.uint8, **fields):
    return make_view(folder / name, noise(channels, dtype=dtype), f=50, **fields)


@pytest.fixture
def kinds(tmp_path):
    """Return one photograph of every kind that is stored in its own way."""
    (tmp_path / "images").mkdir()
    mask, car = np.full(SIZE, 255, np.uint8), np.zeros((12, 16), bool)
    mask[10:20, 5:30], car[9:] = 0, True
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    fields = {
        "plain.png": {},
        "deep.png": {"dtype": np.uint16},
        "masked.png": {"mask_path": tmp_path / "mask.png"},
        "lens.png": {"distortion": Distortion((-0.1, 0.02, 0.0, 0.0))},
        "matted.png": {"channels": 4, "alpha": "background"},
        "matted_deep.png": {"channels": 4, "dtype": np.uint16, "alpha": "background"},
        "cut_out.png": {"channels": 4, "alpha": "mask"},
        "driven.png": {"ego_mask": car},
    }
    return [noisy_view(tmp_path / "images", name, **given) for name, given in fields.items()]


@pytest.fixture
def views(tmp_path):
    (tmp_path / "images").mkdir()
    return [noisy_view(tmp_path / "images", f"{k}.png") for k in range(12)]


def in_files(tmp_path, views, cfg=NONE):
    return ImageStore(views, cfg, folder=tmp_path / "pixels")


def stored(store, count, shrink):
    return [(*store.stored(k, shrink), store.alpha(k, shrink)) for k in range(count)]


def same(store, views, shrinks=SHRINKS):
    """Assert that a store holds the same pixels as one that decodes them."""
    plain = ImageStore(views, DataConfig())
    for shrink in shrinks:
        expected, found = (stored(s, len(views), shrink) for s in (plain, store))
        for a, b in zip(sum(expected, ()), sum(found, ()), strict=True):
            assert (a is None) == (b is None)
            assert a is None or (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
        assert not any(array.flags.writeable for one in found for array in one[:2])
    plain.close()


@pytest.mark.parametrize("shrink", [1, 2, 3])
def test_every_kind_comes_back_bit_for_bit(tmp_path, kinds, shrink):
    store = in_files(tmp_path, kinds)
    for _ in range(2):
        same(store, kinds, [shrink])
    assert store._photographs.decodings == len(kinds)
    # A second store decodes nothing; a store with enough memory removes the files.
    again = in_files(tmp_path, kinds)
    stored(again, len(kinds), shrink)
    assert again._photographs.decodings == 0
    assert any((tmp_path / "pixels").rglob("*.px"))
    in_files(tmp_path, kinds, DataConfig()).expect(SHRINKS)
    assert not (tmp_path / "pixels").exists()


@pytest.mark.parametrize("what", ["image_path", "mask_path", "distortion", "ego_mask", "K"])
def test_pixels_are_decoded_anew_if_their_view_changes(tmp_path, what):
    view = noisy_view(tmp_path, "a.png", distortion=Distortion((0.1, 0, 0, 0)))
    in_files(tmp_path, [view]).stored(0)
    (first,) = (tmp_path / "pixels").rglob("*.px")
    path = view.image_path if what == "image_path" else tmp_path / "other.png"
    cv2.imwrite(str(path), np.full((*SIZE, 3), 7, np.uint8))
    os.utime(path, ns=(1, 1))
    values = {"image_path": path, "mask_path": path, "distortion": Distortion((0.2, 0, 0, 0))}
    values |= {"ego_mask": np.ones((3, 4), bool), "K": view.K * [[1.5], [1.5], [1]]}
    changed = [dataclasses.replace(view, **{what: values[what]})]
    store = in_files(tmp_path, changed)
    assert not first.exists()
    same(store, changed, [1])
    assert store._photographs.decodings == 1


@pytest.mark.parametrize("damage", [lambda d: d[:100], lambda d: d[:-64], lambda d: b"x" * len(d)])
def test_a_damaged_file_is_made_again(tmp_path, damage):
    view = noisy_view(tmp_path, "a.png")
    in_files(tmp_path, [view]).stored(0)
    (path,) = (tmp_path / "pixels").rglob("*.px")
    path.write_bytes(damage(path.read_bytes()))
    (path.parent / ".writing-killed.px").write_bytes(b"half")
    same(in_files(tmp_path, [view]), [view], [1])
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_disk_without_room_is_refused_at_once_or_names_the_option(tmp_path, kinds, monkeypatch):
    full = Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with monkeypatch.context() as patch:
        patch.setattr(cache, "atomic_write", full)
        with refused("No space left on device", "--data.cache-mb"):
            in_files(tmp_path, kinds).stored(0)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with refused(r"8 decoded photographs need 1 MB of disk.*1 MB left", "--data.cache-mb 1"):
        in_files(tmp_path, kinds)
    in_files(tmp_path, kinds, DataConfig())


def test_threads_decode_all_sizes_and_the_caller_none(tmp_path, views):
    views[5].image_path.write_bytes(b"no photograph")
    store = in_files(tmp_path, views)
    store.expect(SHRINKS)
    for thread in store._photographs._ahead._threads:
        thread.join()
    # An error of a thread is reported to the caller that asks for the photograph.
    with refused(r"5\.png"):
        store.stored(5)
    for row in {*range(12)} - {5}:
        assert [len(store.stored(row, s)[0]) for s in SHRINKS] == [24, 48]
    assert store._photographs.decodings == 0
    store.close()


@pytest.mark.parametrize("end", ["closed", "forgotten"])
def test_threads_end_with_the_store(tmp_path, views, monkeypatch, end):
    begun, go = threading.Event(), threading.Event()

    def held(*given):
        begun.set()
        assert go.wait(60)
        return decode.decode(*given)

    monkeypatch.setattr(cache, "decode", held)
    monkeypatch.setattr(cache, "MOST_THREADS", 1)
    store = in_files(tmp_path, views)
    store.expect(SHRINKS)
    assert begun.wait(60)
    (thread,) = store._photographs._ahead._threads
    threading.Timer(0.05, go.set).start()
    if end == "closed":
        store.close()
    del store
    assert not thread.is_alive()
    assert len(list((tmp_path / "pixels").rglob("*.px"))) == 2  # sizes of one photograph


@pytest.mark.parametrize("ended", [False, True])
def test_decoded_photographs_go_however_their_run_ends(tmp_path, views, ended):
    with contextlib.suppress(KeyboardInterrupt), decoded_into(tmp_path / "pixels") as folder:
        store = ImageStore(views, NONE, folder=folder)
        store.expect(SHRINKS)
        store.get(0)
        assert [*folder.glob("*/*.px")]
        if not ended:
            raise KeyboardInterrupt
    assert not folder.exists()
    assert store._photographs._bytes == 0
