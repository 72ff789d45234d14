"""Solved photometry in PPISP's parameters gives the pictures of our image formation."""

import jax
import numpy as np
import pytest

from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.photometry import ppisp
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.ppisp_start import start_of

EXPOSURES, GAMMAS = np.array([0.5, 1.0, 3.0]), np.full(3, 2.2)
BALANCES = np.log([[1.2, 1.0, 1 / 1.2], [1, 1, 1], [0.8, 1.1, 1 / 0.88]])
# The second camera has vignetting per channel; its photographs are in portrait format.
DARKENS = (((-0.3, 0.05, 0.0),), ((-0.4, 0, 0), (-0.5, 0, 0), (-0.6, 0, 0)))
CAMERAS = tuple(CameraFormation(n, v) for n, v in zip("ab", DARKENS, strict=True))
SIZES = {"a": (48, 32), "b": (32, 48)}


@pytest.mark.parametrize(("curve", "codes"), [("power", 0.5), ("srgb", 1.5)])
def test_greys_and_vignetting_agree_with_the_photographs(curve, codes):
    cfg, cameras = PhotometryConfig(curve=curve, cameras=CAMERAS), ("a", "a", "b")
    start = start_of(cfg, cameras, EXPOSURES, GAMMAS, BALANCES, SIZES)
    assert start.codes.max() < codes
    # PPISP pulls the mean exposure to 0 stops.
    assert float(np.mean(start.parameters.exposures)) == pytest.approx(0, abs=1e-5)
    for row, name in enumerate(cameras):
        width, height = SIZES[name]
        ramp = np.geomspace(1e-3, 2, width * height, dtype=np.float32)
        grey = np.repeat(np.random.default_rng(row).permutation(ramp)[:, None], 3, 1)
        grey = grey.reshape(height, width, 3)
        settings = {"white_balance": tuple(BALANCES[row]), "camera": "ab".index(name)}
        expected = develop(grey, DisplayTransform(EXPOSURES[row], 2.2, cfg, **settings))
        light = grey * np.float32(2**start.radiance_ev)
        found = jax.jit(ppisp.applied)(light, start.parameters.view(row))
        off = 255 * np.abs(np.asarray(found) - expected)
        assert off.max() < codes + 1
        assert off.mean() < 1.5
