"""Photographs that memory does not hold are decoded once, ahead, and read bit for bit."""

import contextlib
import dataclasses
import errno
import os
import shutil
import threading
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scene.helpers import make_view, refused

from p2gs_jax.config import DataConfig
from p2gs_jax.scene.pixels import cache, decode
from p2gs_jax.scene.pixels.store import ImageStore, decoded_into
from p2gs_jax.types import Distortion

SIZE, SHRINKS = (48, 64), (2, 1)
NONE = DataConfig(cache_mb=0)


def noisy_view(folder, name, channels=3, dtype=np.uint8, **fields):
    """Write noise and return a view of it."""
    rng = np.random.default_rng(len(name) + sum(name.encode()))
    pixels = rng.integers(0, np.iinfo(dtype).max, (*SIZE, channels), dtype=dtype, endpoint=True)
    return make_view(folder / name, pixels, f=50, **fields)


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
        "driven.png": {"own_car": car},
    }
    return [noisy_view(tmp_path / "images", name, **given) for name, given in fields.items()]


@pytest.fixture
def views(tmp_path):
    (tmp_path / "images").mkdir()
    return [noisy_view(tmp_path / "images", f"{k}.png") for k in range(12)]


def in_files(tmp_path, views, cfg=NONE):
    return ImageStore(views, cfg, folder=tmp_path / "pixels")


def stored(store, count, shrink):
    """Return all that a store holds of every photograph."""
    return [(*store.stored(k, shrink), store.alpha(k, shrink)) for k in range(count)]


def same(store, views, shrinks=SHRINKS):
    """Assert that a store holds what another decodes."""
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
    assert store.decodings == len(kinds)
    # Another start decodes nothing; one with more memory clears what was written.
    again = in_files(tmp_path, kinds)
    stored(again, len(kinds), shrink)
    assert again.decodings == 0
    assert any((tmp_path / "pixels").rglob("*.px"))
    in_files(tmp_path, kinds, DataConfig()).expect(SHRINKS)
    assert not (tmp_path / "pixels").exists()


@pytest.mark.parametrize("what", ["image_path", "mask_path", "distortion", "own_car", "K"])
def test_what_pixels_depend_on_makes_them_anew(tmp_path, what):
    view = noisy_view(tmp_path, "a.png", distortion=Distortion((0.1, 0, 0, 0)))
    in_files(tmp_path, [view]).stored(0)
    (first,) = (tmp_path / "pixels").rglob("*.px")
    path = view.image_path if what == "image_path" else tmp_path / "other.png"
    cv2.imwrite(str(path), np.full((*SIZE, 3), 7, np.uint8))
    os.utime(path, ns=(1, 1))
    values = {"image_path": path, "mask_path": path, "distortion": Distortion((0.2, 0, 0, 0))}
    values |= {"own_car": np.ones((3, 4), bool), "K": view.K * [[1.5], [1.5], [1]]}
    changed = [dataclasses.replace(view, **{what: values[what]})]
    store = in_files(tmp_path, changed)
    assert not first.exists()
    same(store, changed, [1])
    assert store.decodings == 1


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
    message = r"8 decoded photographs take 1 MB of disk.*1 MB left"
    with refused(message, "--data.cache-mb 1"):
        in_files(tmp_path, kinds)
    in_files(tmp_path, kinds, DataConfig())


# ------------------------------------------------------------------ ahead


def test_threads_decode_all_sizes_and_the_caller_none(tmp_path, views):
    views[5].image_path.write_bytes(b"no photograph")
    store = in_files(tmp_path, views)
    store.expect(SHRINKS)
    for thread in store._photographs._ahead._threads:
        thread.join()
    # What a thread cannot decode is reported to the caller that asks.
    with refused(r"5\.png"):
        store.stored(5)
    for row in {*range(12)} - {5}:
        assert [len(store.stored(row, s)[0]) for s in SHRINKS] == [24, 48]
    assert store.decodings == 0
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
    assert len(list((tmp_path / "pixels").rglob("*.px"))) == 2


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
    assert store._photographs.cached_bytes == 0
