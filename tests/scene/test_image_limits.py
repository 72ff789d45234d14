"""Pictures that announce more than they should are refused before they are decoded."""

import struct
import tracemalloc
import zlib

import pytest
from helpers import write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.pixels.store import ImageStore

SIDE = 20_000
CFG = DataConfig(test_every=0)


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@pytest.fixture(scope="module")
def bomb() -> bytes:
    """Return a black picture of one bit a pixel: 50 KB."""
    header = struct.pack(">IIBBBBB", SIDE, SIDE, 1, 0, 0, 0, 0)
    data = zlib.compress(bytes(SIDE * (1 + SIDE // 8)), 1)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def test_what_is_too_large_is_refused_by_its_header(tmp_path, bomb):
    write_tiny_model(tmp_path)
    (tmp_path / "images" / "im 1.png").write_bytes(bomb)
    tracemalloc.start()
    try:
        with pytest.raises(UserError, match=r"im 1.png has more than 179 million pixels"):
            load_scene(tmp_path, CFG)
        assert tracemalloc.get_traced_memory()[1] < SIDE * SIDE / 4
    finally:
        tracemalloc.stop()


def test_so_is_a_mask(tmp_path, bomb):
    write_tiny_model(tmp_path)
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "im 1.png").write_bytes(bomb)
    store = ImageStore(load_scene(tmp_path, CFG).views, CFG)
    with pytest.raises(UserError, match=r"im 1.png has more than 179 million pixels"):
        store.get(1)
    store.close()


def test_photographs_alone_are_looked_at_before_their_features_are(tmp_path, bomb):
    (tmp_path / "a.png").write_bytes(bomb)
    with pytest.raises(UserError, match=r"a.png has more than 179 million pixels"):
        load_scene(tmp_path, CFG)


def test_what_is_no_file_is_no_photograph(tmp_path):
    (tmp_path / "a.png").mkdir()
    with pytest.raises(UserError, match="cannot decode"):
        image_size(tmp_path / "a.png")
