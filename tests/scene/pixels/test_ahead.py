"""Processes decode ahead what memory does not hold; whoever asks first waits, or decodes alone."""

import os
import signal
import time

import cv2
import numpy as np
import pytest

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels import cache as ahead
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import View

COUNT, SHRINKS = 12, (2, 1)


@pytest.fixture
def views(tmp_path):
    rng, out = np.random.default_rng(0), []
    (tmp_path / "images").mkdir()
    for k in range(COUNT):
        path = tmp_path / "images" / f"{k}.png"
        cv2.imwrite(str(path), rng.integers(0, 256, (40, 60, 3), np.uint8))
        pose, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
        out.append(View(path.name, path, "0", pose, K, 60, 40))
    return out


@pytest.fixture
def few(monkeypatch):
    """Let processes begin for a few photographs; return those that were started."""
    started = []
    begin = ahead.subprocess.Popen

    def kept(*args, **options):
        started.append(begin(*args, **options))
        return started[-1]

    monkeypatch.setattr(ahead, "FEWEST", 1)
    monkeypatch.setattr(ahead.subprocess, "Popen", kept)
    return started


def store_in(tmp_path, views):
    return ImageStore(views, DataConfig(cache_mb=0), folder=tmp_path / "pixels")


def same(store, views):
    """Assert that a store holds what another decodes."""
    plain = ImageStore(views, DataConfig())
    for row in range(len(views)):
        for shrink in SHRINKS:
            for a, b in zip(plain.stored(row, shrink), store.stored(row, shrink), strict=True):
                assert np.array_equal(a, b)
    plain.close()


def wait_until(true, seconds=60):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "nothing happens"
        time.sleep(0.02)


def test_processes_decode_all_sizes_and_the_caller_none(tmp_path, views, few):
    store = store_in(tmp_path, views)
    store.expect(SHRINKS)
    wait_until(lambda: all(p.poll() is not None for p in few))
    assert len(few) > 0
    same(store, views)
    assert store.decodings == 0
    store.close()


def test_the_caller_goes_on_where_a_process_dies(tmp_path, views, few):
    store = store_in(tmp_path, views)
    store.expect(SHRINKS)
    for process in few:
        os.kill(process.pid, signal.SIGKILL)
    same(store, views)
    assert store.decodings > 0
    store.close()


def test_one_who_decodes_alone_opens_a_photograph_once(tmp_path, views):
    """Too few for processes: the size that is asked for first brings the others with it."""
    store = store_in(tmp_path, views)
    store.expect(SHRINKS)
    store.stored(3, 1)
    views[3].image_path.unlink()
    assert store.stored(3, 2)[0].shape == (20, 30, 3)
    assert store.decodings == 2
    store.close()


def test_what_a_process_cannot_decode_is_said_by_who_asks(tmp_path, views, few):
    views[5].image_path.write_bytes(b"no photograph")
    store = store_in(tmp_path, views)
    store.expect(SHRINKS)
    wait_until(lambda: all(p.poll() is not None for p in few))
    with pytest.raises(UserError, match=r"5\.png"):
        store.stored(5)
    assert store.stored(6)[0].shape == (40, 60, 3)
    assert store.decodings == 0
    store.close()


@pytest.mark.parametrize("end", ["closed", "forgotten"])
def test_processes_end_with_the_store(tmp_path, views, few, end):
    store = store_in(tmp_path, views)
    store.expect(SHRINKS)
    assert few
    if end == "closed":
        store.close()
    del store
    assert all(p.poll() is not None for p in few)


def test_a_set_that_memory_holds_starts_none(tmp_path, views, few):
    store = ImageStore(views, DataConfig(), folder=tmp_path / "pixels")
    store.expect(SHRINKS)
    assert not few
    same(store, views)
    store.close()
