"""PLY of Gaussians: the reference fields, bit for bit, some rows at a time, with little memory."""

import dataclasses
import tracemalloc

import jax
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from p2gs_jax.errors import UserError
from p2gs_jax.formats import ply
from p2gs_jax.formats.ply import VIBRATION, field_names, read_ply, write_ply, write_radiance
from p2gs_jax.types import Gaussians, Vibration


def population(n, degree=1, *, moves=False):
    rng = np.random.default_rng(n)

    def draw(*shape):
        return rng.normal(size=(n, *shape)).astype(np.float32)

    vibration = Vibration(draw(3), draw(), draw()) if moves else None
    shapes = ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3))
    return Gaussians(*(draw(*shape) for shape in shapes), vibration=vibration)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("count", [0, 1, 9, 10, 11, 25])
def test_every_row_comes_back_whatever_the_chunk(tmp_path, monkeypatch, count, moves):
    monkeypatch.setattr(ply, "CHUNK", 10)
    g = population(count, degree=2, moves=moves)
    assert write_ply(tmp_path / "a.ply", g, ["line"]) == count
    for a, b in zip(jax.tree.leaves(read_ply(tmp_path / "a.ply")), jax.tree.leaves(g), strict=True):
        assert np.asarray(a).tobytes() == b.tobytes()


def test_only_live_gaussians_are_written_and_still_ones_have_no_fields_of_motion(tmp_path):
    g, alive, path = population(7, moves=True), np.arange(7) != 2, tmp_path / "radiance.ply"
    assert write_radiance(path, g, alive, activation="exp") == 6
    for a, b in zip(jax.tree.leaves(read_ply(path)), jax.tree.leaves(g), strict=True):
        np.testing.assert_array_equal(a, b[alive])
    write_radiance(path, dataclasses.replace(g, vibration=None), alive, activation="exp")
    assert not set(VIBRATION) & set(PlyData.read(str(path))["vertex"].data.dtype.names)
    assert read_ply(path).vibration is None
    assert write_radiance(path, population(7, degree=3), np.zeros(7, bool), activation="exp") == 0
    assert read_ply(path).sh.shape == (0, 16, 3)


def test_fields_and_bytes_are_the_reference_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "CHUNK", 4)
    g, alive = population(23, degree=3), np.arange(23) % 5 != 2
    names = field_names(16)
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    rest = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    assert names[54:] == ["opacity", *rest[0], *rest[1]]
    comments = ["p2gs-jax: linear HDR radiance", "p2gs-jax: radiance activation exp"]
    write_radiance(tmp_path / "ours.ply", g, alive, activation="exp")
    # Red's coefficients come first, all of them.
    bands = g.sh[:, 1:].transpose(0, 2, 1).reshape(23, -1)
    zero, logits = np.zeros((23, 3), np.float32), g.opacity_logits[:, None]
    columns = [g.means, zero, g.sh[:, 0], bands, logits, g.log_scales, g.quats]
    table = np.ascontiguousarray(np.concatenate(columns, 1)[alive])
    rows = table.view([(name, "<f4") for name in names]).reshape(-1)
    element = PlyElement.describe(rows, "vertex")
    PlyData([element], byte_order="<", comments=comments).write(str(tmp_path / "theirs.ply"))
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "theirs.ply").read_bytes()


def test_memory_does_not_grow_with_the_file(tmp_path, monkeypatch):
    """Beside the population: a few chunks while writing, a copy of its largest part while reading.

    tracemalloc counts NumPy's arrays; those of the device are not among them.
    """
    monkeypatch.setattr(ply, "CHUNK", 1000)
    g = population(40_000, degree=3)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(g))
    tracemalloc.start()
    try:
        write_ply(tmp_path / "a.ply", g, [])
        assert tracemalloc.get_traced_memory()[1] < size / 8
        tracemalloc.reset_peak()
        read_ply(tmp_path / "a.ply")
        assert tracemalloc.get_traced_memory()[1] < 1.2 * size
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kept", [0.3, 0.99, None])
def test_a_file_that_was_cut_and_another_one_are_refused(tmp_path, kept):
    path = tmp_path / "a.ply"
    write_ply(path, population(100), [])
    content = path.read_bytes()
    path.write_bytes(b"hello" if kept is None else content[: int(kept * len(content))])
    with pytest.raises(UserError, match=r"a\.ply is not a valid PLY of Gaussians"):
        read_ply(path)
