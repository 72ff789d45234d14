"""A run's scene.npz of any bytes is read or refused."""

import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.run.scene_file import SCENE_FILE, read_scene


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / SCENE_FILE
    arrays = np.random.default_rng(0).normal(size=(50, 3))
    np.savez_compressed(path, json=np.array('{"views": [], "notes": []}'), points=arrays)
    return path.read_bytes()


def test_a_broken_scene_file_is_refused(tmp_path, whole):
    rng = np.random.default_rng(1)
    broken = [b"", b"\0", whole[: len(whole) // 2]]
    for at in rng.choice(len(whole) * 8, 150, replace=False):
        flipped = bytearray(whole)
        flipped[at // 8] ^= 1 << (at % 8)
        broken.append(bytes(flipped))
    for data in broken:
        (tmp_path / SCENE_FILE).write_bytes(data)
        # What the file says is no whole scene in any case.
        with pytest.raises(UserError, match=SCENE_FILE):
            read_scene(tmp_path, tmp_path)
