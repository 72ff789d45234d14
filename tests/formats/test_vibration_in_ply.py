"""Gaussians that vibrate come back from `radiance.ply` bit for bit; others write no such fields."""

import dataclasses

import jax
import numpy as np
from plyfile import PlyData

from p2gs_jax.formats.ply import VIBRATION, read_ply, write_radiance
from p2gs_jax.types import Gaussians, Vibration

RNG = np.random.default_rng(0)
SHAPES = ((3,), (4,), (3,), (), (4, 3))


def test_round_trip(tmp_path):
    values = [RNG.normal(size=(7, *shape)).astype(np.float32) for shape in SHAPES]
    moves = [RNG.normal(size=(7, *shape)).astype(np.float32) for shape in ((3,), (), ())]
    g = Gaussians(*values, vibration=Vibration(*moves))
    alive = np.arange(7) != 2
    path = tmp_path / "radiance.ply"
    assert write_radiance(path, g, alive, activation="exp") == 6
    back = read_ply(path)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(g), strict=True):
        np.testing.assert_array_equal(a, b[alive])
    write_radiance(path, dataclasses.replace(g, vibration=None), alive, activation="exp")
    assert not set(VIBRATION) & set(PlyData.read(str(path))["vertex"].data.dtype.names)
    assert read_ply(path).vibration is None
