"""Photographs that memory does not hold are decoded once, and read from files bit for bit."""

import dataclasses
import errno
import os
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels import cache as module
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Distortion, View

SIZE = (48, 64)


def make_view(folder, name, channels=3, dtype=np.uint8, **fields):
    """Write noise and return a view of it."""
    rng = np.random.default_rng(len(name) + sum(name.encode()))
    pixels = rng.integers(0, np.iinfo(dtype).max, (*SIZE, channels), dtype=dtype, endpoint=True)
    assert cv2.imwrite(str(folder / name), pixels)
    h, w = SIZE
    K = np.array([[50, 0, w / 2], [0, 50, h / 2], [0, 0, 1]], np.float32)
    pose = np.eye(4, dtype=np.float32)
    return View(name, folder / name, "0", pose, K, w, h, **fields)


@pytest.fixture
def views(tmp_path):
    """Return one photograph of every kind that is stored in its own way."""
    (tmp_path / "images").mkdir()
    mask = np.full(SIZE, 255, np.uint8)
    mask[10:20, 5:30] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    car = np.zeros((12, 16), bool)
    car[9:] = True
    kinds = {
        "plain.png": {},
        "deep.png": {"dtype": np.uint16},
        "masked.png": {"mask_path": tmp_path / "mask.png"},
        "lens.png": {"distortion": Distortion((-0.1, 0.02, 0.0, 0.0))},
        "matted.png": {"channels": 4, "alpha": "background"},
        "matted_deep.png": {"channels": 4, "dtype": np.uint16, "alpha": "background"},
        "cut_out.png": {"channels": 4, "alpha": "mask"},
        "driven.png": {"own_car": car},
    }
    return [make_view(tmp_path / "images", name, **given) for name, given in kinds.items()]


def stored(store, count, shrink):
    """Return all that a store holds of every photograph."""
    return [(*store.stored(k, shrink), store.alpha(k, shrink)) for k in range(count)]


@pytest.mark.parametrize("shrink", [1, 2, 3])
def test_every_kind_comes_back_bit_for_bit(tmp_path, views, shrink):
    once = stored(ImageStore(views, DataConfig()), len(views), shrink)
    store = ImageStore(views, DataConfig(cache_mb=0), folder=tmp_path / "pixels")
    for _ in range(2):
        again = stored(store, len(views), shrink)
        for expected, found in zip(once, again, strict=True):
            for a, b in zip(expected, found, strict=True):
                assert (a.dtype, a.shape) == (b.dtype, b.shape)
                assert a.tobytes() == b.tobytes()
            assert not any(array.flags.writeable for array in found[:2])
    assert store.decodings == len(views)


def test_another_start_decodes_nothing(tmp_path, views):
    for expected in (len(views), 0):
        store = ImageStore(views, DataConfig(cache_mb=0), folder=tmp_path / "pixels")
        stored(store, len(views), 1)
        store.close()
        assert store.decodings == expected


def test_what_is_held_stays_below_the_bound(tmp_path):
    """64 photographs of 512x512 take 64 MiB; 4 may be held, and none is decoded twice."""
    pixels = np.zeros((512, 512, 3), np.uint8)
    made = []
    for k in range(64):
        cv2.imwrite(str(tmp_path / f"{k}.png"), pixels + k)
        pose, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
        made.append(View(f"{k}.png", tmp_path / f"{k}.png", "0", pose, K, 512, 512))
    store = ImageStore(made, DataConfig(cache_mb=4), folder=tmp_path / "pixels")
    for k in (*range(64), *range(64)):
        assert store.stored(k)[0].max() == k
        assert store.cached_bytes <= 4 * 2**20
    assert store.decodings == 64


def test_a_set_that_fits_writes_nothing_and_clears_what_an_earlier_start_wrote(tmp_path, views):
    folder = tmp_path / "pixels"
    stored(ImageStore(views, DataConfig(cache_mb=0), folder=folder), len(views), 1)
    assert any(folder.rglob("*.px"))
    stored(ImageStore(views, DataConfig(), folder=folder), len(views), 1)
    assert not folder.exists()


def _photograph(view, folder):
    other = np.full((*SIZE, 3), 7, np.uint8)
    cv2.imwrite(str(view.image_path), other)
    os.utime(view.image_path, ns=(1, 1))
    return view


def _lens(view, folder):
    return dataclasses.replace(view, distortion=Distortion((0.2, 0, 0, 0)))


def _mask(view, folder):
    mask = np.zeros(SIZE, np.uint8)
    cv2.imwrite(str(folder / "other.png"), mask)
    return dataclasses.replace(view, mask_path=folder / "other.png")


def _car(view, folder):
    return dataclasses.replace(view, own_car=np.ones((3, 4), bool))


def _focal(view, folder):
    return dataclasses.replace(view, K=view.K * [[1.5], [1.5], [1]])


@pytest.mark.parametrize("change", [_photograph, _lens, _mask, _car, _focal])
def test_what_pixels_depend_on_makes_them_anew(tmp_path, change):
    view = make_view(tmp_path, "a.png", distortion=Distortion((0.1, 0, 0, 0)))
    folder = tmp_path / "pixels"
    ImageStore([view], DataConfig(cache_mb=0), folder=folder).stored(0)
    (first,) = folder.rglob("*.px")
    changed = change(view, tmp_path)
    store = ImageStore([changed], DataConfig(cache_mb=0), folder=folder)
    assert not first.exists()
    expected = ImageStore([changed], DataConfig()).stored(0)
    for a, b in zip(expected, store.stored(0), strict=True):
        assert np.array_equal(a, b)
    assert store.decodings == 1


@pytest.mark.parametrize("damage", [lambda d: d[:100], lambda d: d[:-64], lambda d: b"x" * len(d)])
def test_a_damaged_file_is_made_again(tmp_path, damage):
    view, folder = make_view(tmp_path, "a.png"), tmp_path / "pixels"
    ImageStore([view], DataConfig(cache_mb=0), folder=folder).stored(0)
    (path,) = folder.rglob("*.px")
    path.write_bytes(damage(path.read_bytes()))
    (path.parent / ".writing-killed.px").write_bytes(b"half")
    store = ImageStore([view], DataConfig(cache_mb=0), folder=folder)
    expected = ImageStore([view], DataConfig()).stored(0)
    assert np.array_equal(store.stored(0)[0], expected[0])
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_disk_without_room_is_refused_at_once(tmp_path, views, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    with pytest.raises(
        UserError, match=r"8 decoded photographs take 1 MB of disk.*1 MB left"
    ) as no:
        ImageStore(views, DataConfig(cache_mb=0), folder=tmp_path / "pixels")
    assert "--data.cache-mb 1" in str(no.value)
    ImageStore(views, DataConfig(), folder=tmp_path / "pixels")


def test_a_disk_that_fills_names_the_option(tmp_path, views, monkeypatch):
    def full(*args, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module, "atomic_write", full)
    store = ImageStore(views, DataConfig(cache_mb=0), folder=tmp_path / "pixels")
    with pytest.raises(UserError, match="No space left on device") as no:
        store.stored(0)
    assert "--data.cache-mb" in str(no.value)
