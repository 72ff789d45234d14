"""What a run leaves out is read again as it was written, and a broken file is said."""

import numpy as np
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.unexplained import Unexplained
from p2gs_jax.run.left_out_file import LeftOutFile

RNG = np.random.default_rng(0)


def masks():
    """Return masks of two views of different sizes."""
    sizes = {0: (5, 7), 3: (4, 4)}
    made = {row: RNG.random(size) < 0.5 for row, size in sizes.items()}
    return {row: Unexplained(mask, float(mask.mean())) for row, mask in made.items()}


def same(found, expected):
    assert set(found) == set(expected)
    for row, one in found.items():
        np.testing.assert_array_equal(one.mask, expected[row].mask)
        assert one.mask.dtype == bool
        assert one.share == expected[row].share


@pytest.fixture
def file(tmp_path):
    return LeftOutFile(tmp_path / "left_out.npz")


def test_every_look_is_read_as_it_was(file):
    first, second = masks(), masks()
    file.write(40, first, 1)
    file.write(80, second, 0)
    for step, expected, whole in ((40, first, 1), (80, second, 0)):
        found, count = file.read(step)
        same(found, expected)
        assert count == whole


def test_looks_after_the_step_of_a_checkpoint_are_forgotten(file, tmp_path):
    first = masks()
    file.write(40, first, 0)
    file.write(80, masks(), 0)
    file.keep_until(79)
    same(file.read(40)[0], first)
    with pytest.raises(UserError, match="no look after step 80"):
        file.read(80)
    file.keep_until(0)
    assert not list(tmp_path.iterdir())
    file.keep_until(0)


def test_a_broken_file_is_said(file, tmp_path):
    with pytest.raises(UserError, match=r"left_out\.npz"):
        file.read(40)
    file.write(40, masks(), 0)
    path = tmp_path / "left_out.npz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UserError, match="without --resume"):
        file.read(40)
    with pytest.raises(UserError, match=r"left_out\.npz"):
        file.keep_until(10)
